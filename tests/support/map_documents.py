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
<center><lane id="0" type="none"><roadMark sOffset="0" type="solid" color="yellow"/></lane></center><right>{sides["right"]}</right></laneSection></lanes>
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
