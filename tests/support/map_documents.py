"""Small maps of the formats without logs, made by hand."""

import numpy as np

LANE_M = 3.5


def _lane(number, kind="driving", *, links=(), width=LANE_M, mark="none", more=""):
    link = "".join(f'<{name} id="{target}"/>' for name, target in links)
    return (
        f'<lane id="{number}" type="{kind}"><link>{link}</link><width sOffset="0" a="{width}" b="0" c="0" d="0"/>'
        f'<roadMark sOffset="0" type="{mark}" color="standard"/>{more}</lane>'
    )


def _road(number, start, shape, length, *, lanes, junction=-1, links="", height=(0.0, 0.0), more="", limit=True):
    x, y, heading = start
    sides = {name: "".join(text for n, text in lanes if np.sign(n) == sign) for name, sign in (("left", 1), ("right", -1))}
    kind = '<type s="0" type="town"><speed max="50" unit="km/h"/></type>' if limit else ""
    return f"""
<road id="{number}" length="{length}" junction="{junction}" rule="RHT"><link>{links}</link>{kind}
<planView><geometry s="0" x="{x}" y="{y}" hdg="{heading}" length="{length}">{shape}</geometry></planView>
<elevationProfile><elevation s="0" a="{height[0]}" b="{height[1]}" c="0" d="0"/></elevationProfile>
<lanes><laneSection s="0"><left>{sides["left"]}</left>
<center><lane id="0" type="none"><roadMark sOffset="0" type="solid" color="yellow"/></lane></center>
<right>{sides["right"]}</right></laneSection></lanes>
{more}</road>"""


def opendrive_document():
    """A road that climbs to a junction with a light, from which one lane goes straight on into a spiral and one turns right."""
    arc = 12.0 * np.pi / 2
    ahead = [("successor", n) for n in (-1,)], [("predecessor", -1), ("successor", -1)]
    light = (
        '<signals><signal id="5" s="55" t="-8" dynamic="yes" orientation="+" type="1000001" country="OpenDRIVE"/></signals>'
        '<objects><object id="1" type="crosswalk" s="50" t="-1.75" hdg="0" length="3" width="10.5"/></objects>'
    )
    slow = '<speed sOffset="0" max="30" unit="km/h"/>'
    roads = [
        _road(1, (0, 0, 0), "<line/>", 60, height=(0.0, 0.05), more=light, links='<successor elementType="junction" elementId="9"/>',
              lanes=[(1, _lane(1)), (-1, _lane(-1, mark="broken")), (-2, _lane(-2, mark="solid", more=slow))]),
        _road(10, (60, 0, 0), "<line/>", 20, junction=9, height=(3.0, 0.0),
              links='<predecessor elementType="road" elementId="1" contactPoint="end"/>'
                    '<successor elementType="road" elementId="2" contactPoint="start"/>',
              lanes=[(1, _lane(1, links=[("predecessor", 1), ("successor", 1)])), (-1, _lane(-1, links=ahead[1]))]),
        _road(11, (60, 0, 0), f'<arc curvature="{-1 / 12}"/>', arc, junction=9, height=(3.0, 0.0), limit=False,
              links='<predecessor elementType="road" elementId="1" contactPoint="end"/>'
                    '<successor elementType="road" elementId="3" contactPoint="start"/>',
              lanes=[(-1, _lane(-1, "none")), (-2, _lane(-2, links=[("predecessor", -2), ("successor", -2)]))]),
        _road(2, (80, 0, 0), '<spiral curvStart="0" curvEnd="0.02"/>', 70, height=(3.0, 0.0),
              links='<predecessor elementType="junction" elementId="9"/>',
              more='<signals><signal id="6" s="2" t="5" dynamic="no" orientation="-" type="206"/></signals>',
              lanes=[(1, _lane(1)), (-1, _lane(-1))]),
        _road(3, (72, -12, -np.pi / 2), "<line/>", 50, height=(3.0, 0.0), links='<predecessor elementType="junction" elementId="9"/>',
              lanes=[(-1, _lane(-1, "none")), (-2, _lane(-2))]),
    ]  # fmt: skip
    connection = '<connection id="{}" incomingRoad="{}" connectingRoad="{}" contactPoint="{}"><laneLink from="{}" to="{}"/></connection>'
    connections = [(0, 1, 10, "start", -1, -1), (1, 1, 11, "start", -2, -2), (2, 2, 10, "end", 1, 1)]
    junction = f'<junction id="9">{"".join(connection.format(*entry) for entry in connections)}</junction>'
    controller = '<controller id="c"><control signalId="5"/></controller>'
    return f'<?xml version="1.0"?>\n<OpenDRIVE><header revMajor="1" revMinor="7"/>{"".join(roads)}{controller}{junction}</OpenDRIVE>\n'


def _bound(side, x0, x1, y, z=0.0):
    points = "".join(f"<point><x>{x}</x><y>{y}</y><z>{z}</z></point>" for x in (x0, x1))
    return f"<{side}>{points}<lineMarking>{'solid' if side == 'rightBound' else 'dashed'}</lineMarking></{side}>"


def _lanelet(number, x0, x1, y, more="", kind="urban"):
    """A lanelet from `x0` to `x1`, whose right border is at `y`; to the left if `x1` is smaller."""
    side = np.sign(x1 - x0)
    return (
        f'<lanelet id="{number}">{_bound("leftBound", x0, x1, y + side * LANE_M)}{_bound("rightBound", x0, x1, y)}{more}'
        f"<laneletType>{kind}</laneletType></lanelet>\n"
    )


def _state(tag, step, x, y, speed=None, yaw=0.0):
    velocity = "" if speed is None else f"<velocity><exact>{speed}</exact></velocity>"
    return (
        f"<{tag}><position><point><x>{x}</x><y>{y}</y></point></position><orientation><exact>{yaw}</exact></orientation>"
        f"<time><exact>{step}</exact></time>{velocity}</{tag}>\n"
    )


def commonroad_document(version="2020a"):
    """Two lanes that lead to a light, one lane behind it, one against them; a car, a parked one, and a planning problem."""
    lanelets = [
        _lanelet(
            1,
            0,
            40,
            0,
            '<successor ref="3"/><adjacentLeft ref="2" drivingDir="same"/><trafficSignRef ref="20"/><trafficLightRef ref="30"/>',
        ),
        _lanelet(2, 0, 40, LANE_M, '<adjacentRight ref="1" drivingDir="same"/><adjacentLeft ref="4" drivingDir="opposite"/>'),
        _lanelet(3, 40, 60, 0, '<predecessor ref="1"/>'),
        _lanelet(4, 60, 0, 3 * LANE_M, '<trafficSignRef ref="21"/>'),
        _lanelet(5, 0, 60, -2, kind="sidewalk"),
        _lanelet(6, 20, 24, 0, kind="crosswalk"),
    ]
    signs = [
        f"<trafficSign id='{number}'><trafficSignElement><trafficSignID>{name}</trafficSignID>{value}</trafficSignElement></trafficSign>"
        for number, name, value in ((20, "R2-1", "<additionalValue>12.5</additionalValue>"), (21, "R1-1", ""))
    ]
    cycle = "".join(
        f"<cycleElement><duration>{n}</duration><color>{c}</color></cycleElement>" for n, c in ((5, "green"), (2, "yellow"), (13, "red"))
    )
    light = f'<trafficLight id="30"><cycle>{cycle}<timeOffset>3</timeOffset></cycle><direction>all</direction></trafficLight>'
    crossing = '<intersection id="40"><incoming id="41"><incomingLanelet ref="1"/><successorsStraight ref="3"/></incoming></intersection>'
    shape = "<shape><rectangle><length>4.5</length><width>1.8</width></rectangle></shape>"
    path = "".join(_state("state", step, 2 + 0.8 * step, 1.75, 8.0) for step in range(1, 11))
    dynamic, static = ("dynamicObstacle", "staticObstacle") if version == "2020a" else ("obstacle", "obstacle")
    role = (lambda name: "") if version == "2020a" else (lambda name: f"<role>{name}</role>")
    car = f"{role('dynamic')}<type>car</type>{shape}{_state('initialState', 0, 2, 1.75, 8.0)}<trajectory>{path}</trajectory>"
    parked = f"{role('static')}<type>parkedVehicle</type>{shape}{_state('initialState', 0, 30, 1.0, yaw=0.1)}"
    span = "<time><intervalStart>10</intervalStart><intervalEnd>14</intervalEnd></time>"
    goal = f"<goalState><position><lanelet ref='3'/></position>{span}</goalState>"
    problem = f'<planningProblem id="60">{_state("initialState", 0, 10, 5.25, 6.0)}{goal}</planningProblem>'
    return (
        f'<commonRoad timeStepSize="0.1" commonRoadVersion="{version}" benchmarkID="ZAM_Street-1">\n{"".join([*lanelets, *signs])}{light}'
        f'{crossing}<{dynamic} id="50">{car}</{dynamic}><{static} id="51">{parked}</{static}>{problem}</commonRoad>'
    )


def lanelet2_document():
    """Two lanes side by side, of which the right one leads on and to the right, behind a light and a stop sign; in local metres."""
    nodes = {
        1: (0, 7),
        2: (40, 7),
        3: (0, 3.5),
        4: (40, 3.5),
        5: (0, 0),
        6: (40, 0),
        7: (80, 3.5),
        8: (80, 0),
        9: (60, -20),
        10: (56.5, -20),
    }
    nodes |= {11: (41, -2), 12: (41, -4)}
    ways = {  # points, type, subtype
        20: ((1, 2), "line_thin", "solid"), 21: ((4, 3), "line_thin", "dashed"), 22: ((5, 6), "curbstone", "low"),
        23: ((4, 7), "virtual", ""),
        24: ((6, 8), "virtual", ""), 25: ((4, 9), "virtual", ""), 26: ((6, 10), "virtual", ""), 27: ((11, 12), "traffic_sign", "usR1-1"),
    }  # fmt: skip
    lanelets = {30: (20, 21), 31: (21, 22), 32: (23, 24), 33: (25, 26)}
    tag = lambda pairs: "".join(f'<tag k="{k}" v="{v}"/>' for k, v in pairs.items() if v)  # noqa: E731
    text = [
        f'<node id="{n}" lat="0" lon="0">{tag({"local_x": str(x), "local_y": str(y), "ele": "2"})}</node>\n' for n, (x, y) in nodes.items()
    ]
    for number, (points, kind, subtype) in ways.items():
        refs = "".join(f"<nd ref='{n}'/>" for n in points)
        text.append(f'<way id="{number}">{refs}{tag({"type": kind, "subtype": subtype})}</way>\n')
    rules = "".join(f'<member type="relation" ref="{n}" role="regulatory_element"/>' for n in (40, 42))
    for number, (left, right) in lanelets.items():
        sides = f'<member type="way" ref="{left}" role="left"/><member type="way" ref="{right}" role="right"/>'
        tags = tag({"type": "lanelet", "subtype": "road", "speed_limit": "30 mph" if number == 30 else ""})
        text.append(f'<relation id="{number}">{sides}{rules if number == 31 else ""}{tags}</relation>\n')
    text.append(f'<relation id="40">{tag({"type": "regulatory_element", "subtype": "speed_limit", "sign_type": "50"})}</relation>')
    sign = '<member type="way" ref="27" role="refers"/><member type="relation" ref="31" role="yield"/>'
    text.append(f'<relation id="41">{sign}{tag({"type": "regulatory_element", "subtype": "right_of_way"})}</relation>')
    text.append(f'<relation id="42">{tag({"type": "regulatory_element", "subtype": "traffic_light"})}</relation>')
    return f'<?xml version="1.0"?>\n<osm version="0.6">\n{"".join(text)}</osm>\n'


def interaction_tables(steps=25):
    """The table of two cars, the first at 8 m/s along the right lane of `lanelet2_document`, and that of a person."""
    head = "track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy"
    cars = [f"{head},psi_rad,length,width"]
    cars += [f"1,{n + 1},{100 * n + 100},car,{2 + 0.8 * n:.3f},1.75,8.0,0.0,0.0,4.5,1.8" for n in range(steps)]
    cars += [f"2,{n + 1},{100 * n + 100},car,20.0,5.25,0.0,0.0,0.1,5.0,2.0" for n in range(steps // 2)]
    people = [head, *(f"P1,{n + 1},{100 * n + 100},pedestrian/bicycle,45.0,{-3 - 0.1 * n:.3f},0.0,-1.0" for n in range(5, 9))]
    return "\n".join(cars) + "\n", "\n".join(people) + "\n"


def sumo_net():
    """A street of two lanes and a pavement climbs to a junction with a light; one lane goes ahead, and two in a row turn left."""
    lane = '<lane id="{0}_{1}" index="{1}" speed="{2}" length="1" {3} shape="{4}"/>'.format
    car, walk = 'disallow="pedestrian"', 'allow="pedestrian" width="2.0"'
    edges = {
        "in": [lane("in", 0, 13.89, walk, "0,-4.2,0 40,-4.2,2"), lane("in", 1, 13.89, car, "0,-1.6,0 40,-1.6,2"),
               lane("in", 2, 10, car, "0,1.6,0 40,1.6,2")],
        "ahead": [lane("ahead", 0, 13.89, car, "60,-1.6,2 100,-1.6,2")],
        "aside": [lane("aside", 0, 8.33, f'{car} width="3.0"', "55,12,2 55,40,2")],
        ":J_0": [lane(":J_0", 0, 9, car, "40,-1.6,2 60,-1.6,2")],
        ":J_1": [lane(":J_1", 0, 5, car, "40,1.6,2 48,3,2")],
        ":J_2": [lane(":J_2", 0, 5, car, "48,3,2 53,7,2 55,12,2")],
        ":J_c0": [lane(":J_c0", 0, 1, 'allow="pedestrian" width="4.0"', "38,3 38,-3")],
        ":J_w0": [lane(":J_w0", 0, 1, walk, "40,-5.2 44,-5.2 44,-3.2 40,-3.2")],
    }  # fmt: skip
    roles = {"in": 'from="A" to="J"', "ahead": 'from="J" to="B"', "aside": 'from="J" to="C"'}
    roles |= {":J_c0": 'function="crossing"', ":J_w0": 'function="walkingarea"'}
    inner = 'function="internal"'
    edge = '<edge id="{}" {}>{}</edge>\n'.format
    shown = "".join(edge(name, roles.get(name, inner), "".join(lanes)) for name, lanes in edges.items())
    return f"""<?xml version="1.0"?>
<net version="1.20"><location netOffset="-500.00,20.00" projParameter="+proj=utm"/>
{shown}<tlLogic id="J" type="static" programID="0" offset="5"><phase duration="20" state="Gr"/><phase duration="4" state="yr"/>
<phase duration="16" state="rG"/></tlLogic>
<junction id="J" type="traffic_light" shape="40,3.2 40,-5.2 44,-5.2 60,-3.2 60,0 56.5,12 53.5,12"/>
<connection from="in" to="ahead" fromLane="1" toLane="0" via=":J_0_0" tl="J" linkIndex="0" dir="s" state="O"/>
<connection from="in" to="aside" fromLane="2" toLane="0" via=":J_1_0" tl="J" linkIndex="1" dir="l" state="o"/>
<connection from=":J_0" to="ahead" fromLane="0" toLane="0" dir="s" state="M"/>
<connection from=":J_1" to="aside" fromLane="0" toLane="0" via=":J_2_0" dir="l" state="m"/>
<connection from=":J_2" to="aside" fromLane="0" toLane="0" dir="l" state="M"/>
</net>"""


def sumo_recording(steps, step_s=0.1, *, start_s=30.0, speed=5.0):
    """A car on the right lane at constant speed, one of 5 m with both ends on a circle around (43, 12), and a person (XML, CSV)."""
    xml, table = [], ["timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_angle;vehicle_type;vehicle_speed;vehicle_lane;vehicle_edge"]
    for time in start_s + step_s * np.arange(steps):
        turn = speed * (time - start_s) / 12.0
        angle = 90.0 - np.rad2deg(turn - np.arcsin(2.5 / 12.0))
        users = [
            ("vehicle", "a", 5 + speed * (time - start_s), -1.6, 90.0, "long", speed),
            ("vehicle", "b", 43 + 12 * np.sin(turn), 12 - 12 * np.cos(turn), angle, "DEFAULT_VEHTYPE", speed),
            ("person", "a", 10.0, -4.2, 180.0, "DEFAULT_PEDTYPE", 0.0),
        ]
        rows = "".join(
            f'<{tag} id="{name}" x="{x:.4f}" y="{y:.4f}" angle="{angle:.4f}" type="{kind}" speed="{v}"/>'
            for tag, name, x, y, angle, kind, v in users
        )
        xml.append(f'<timestep time="{time:.2f}">{rows}</timestep>\n')
        for tag, name, x, y, angle, kind, v in users:
            place = ";in" if tag == "person" else "in_1;"
            table.append(f"{time:.2f};{name};{x:.4f};{y:.4f};{angle:.4f};{kind};{v};{place}")
    head = f'<net-file value="some/where/town.net.xml"/><step-length value="{step_s}"/>'
    return f"<?xml version='1.0'?>\n<!-- {head} -->\n<fcd-export>\n{''.join(xml)}</fcd-export>", "\n".join(table) + "\n"
