"""The protobuf messages of the Waymo Open Motion Dataset that the readers need, built in code: no generated modules, no TensorFlow.

Names and numbers are those of `scenario.proto` and `map.proto` (github.com/waymo-research/waymo-open-dataset) and of
TensorFlow's `example.proto` and `feature.proto`. Fields that no reader uses (lidar, camera tokens, boundaries of lanes) are left out:
protobuf skips them. Three types are declared as others of the same encoding: enumerations as integers, so that an unknown value is refused
instead of read as the default; texts as bytes, because they may not be UTF-8; and the map of features as the list of its entries.
"""

from typing import Any

from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

PACKAGE = "scenefactory.womd"  # of these messages in their own pool
CHOICE = "feature_data"  # the name of MapFeature's oneof

# message -> fields, written as in a .proto; `oneof` marks those of CHOICE
LAYOUT = {
    "Scenario": (
        "repeated double timestamps_seconds = 1",
        "repeated Track tracks = 2",
        "repeated int32 objects_of_interest = 4",
        "optional bytes scenario_id = 5",
        "optional int32 sdc_track_index = 6",
        "repeated DynamicMapState dynamic_map_states = 7",
        "repeated MapFeature map_features = 8",
        "optional int32 current_time_index = 10",
        "repeated RequiredPrediction tracks_to_predict = 11",
    ),
    "Track": ("optional int32 id = 1", "optional int32 object_type = 2", "repeated ObjectState states = 3"),
    "ObjectState": (
        "optional double center_x = 2",
        "optional double center_y = 3",
        "optional double center_z = 4",
        "optional float length = 5",
        "optional float width = 6",
        "optional float height = 7",
        "optional float heading = 8",
        "optional float velocity_x = 9",
        "optional float velocity_y = 10",
        "optional bool valid = 11",
    ),
    "RequiredPrediction": ("optional int32 track_index = 1", "optional int32 difficulty = 2"),
    "DynamicMapState": ("repeated TrafficSignalLaneState lane_states = 1",),
    "TrafficSignalLaneState": ("optional int64 lane = 1", "optional int32 state = 2", "optional MapPoint stop_point = 3"),
    "MapFeature": (
        "optional int64 id = 1",
        "oneof LaneCenter lane = 3",
        "oneof RoadLine road_line = 4",
        "oneof RoadEdge road_edge = 5",
        "oneof StopSign stop_sign = 7",
        "oneof Crosswalk crosswalk = 8",
        "oneof SpeedBump speed_bump = 9",
        "oneof Driveway driveway = 10",
    ),
    "MapPoint": ("optional double x = 1", "optional double y = 2", "optional double z = 3"),
    "LaneCenter": (
        "optional double speed_limit_mph = 1",
        "optional int32 type = 2",
        "repeated MapPoint polyline = 8",
        "repeated int64 entry_lanes = 9",
        "repeated int64 exit_lanes = 10",
        "repeated LaneNeighbor left_neighbors = 11",
        "repeated LaneNeighbor right_neighbors = 12",
    ),
    "LaneNeighbor": ("optional int64 feature_id = 1",),
    "RoadLine": ("optional int32 type = 1", "repeated MapPoint polyline = 2"),
    "RoadEdge": ("optional int32 type = 1", "repeated MapPoint polyline = 2"),
    "StopSign": ("repeated int64 lane = 1", "optional MapPoint position = 2"),
    "Crosswalk": ("repeated MapPoint polygon = 1",),
    "SpeedBump": ("repeated MapPoint polygon = 1",),
    "Driveway": ("repeated MapPoint polygon = 1",),
    "Example": ("optional Features features = 1",),
    "Features": ("repeated FeatureEntry feature = 1",),
    "FeatureEntry": ("optional bytes key = 1", "optional Feature value = 2"),
    "Feature": ("optional BytesList bytes_list = 1", "optional FloatList float_list = 2", "optional Int64List int64_list = 3"),
    "BytesList": ("repeated bytes value = 1",),
    "FloatList": ("repeated float value = 1",),
    "Int64List": ("repeated int64 value = 1",),
}


def _describe() -> FileDescriptorProto:
    """LAYOUT as protobuf's own description of a file."""
    file = FileDescriptorProto(name="womd.proto", package=PACKAGE, syntax="proto2")
    for name, fields in LAYOUT.items():
        message = file.message_type.add(name=name)
        for text in fields:
            label, kind, field, _, number = text.split()
            entry = message.field.add(name=field, number=int(number))
            entry.label = FieldDescriptorProto.LABEL_REPEATED if label == "repeated" else FieldDescriptorProto.LABEL_OPTIONAL
            if kind in LAYOUT:
                entry.type, entry.type_name = FieldDescriptorProto.TYPE_MESSAGE, f".{PACKAGE}.{kind}"
            else:
                entry.type = FieldDescriptorProto.Type.Value(f"TYPE_{kind.upper()}")
            if label == "oneof":
                entry.oneof_index = 0
                if not message.oneof_decl:
                    message.oneof_decl.add(name=CHOICE)
    return file


def _build() -> tuple[Any, Any]:
    """The classes of the two messages of records, in a pool of their own: generated modules may have the same names."""
    pool = DescriptorPool()
    pool.AddSerializedFile(_describe().SerializeToString())
    scenario, example = (GetMessageClass(pool.FindMessageTypeByName(f"{PACKAGE}.{name}")) for name in ("Scenario", "Example"))
    return scenario, example


Scenario, Example = _build()
