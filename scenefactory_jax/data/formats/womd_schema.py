"""The protobuf messages of the Waymo Open Motion Dataset that the readers need, built in code: no generated modules, no TensorFlow.

Names and numbers are those of `scenario.proto` and `map.proto` (github.com/waymo-research/waymo-open-dataset) and of
TensorFlow's `example.proto` and `feature.proto`. Fields that no reader uses (lidar, camera tokens, boundaries of lanes) are left out:
protobuf skips them. Three types are declared as others of the same encoding: enumerations as integers, so that an unknown value is refused
instead of read as the default; texts as bytes, because they may not be UTF-8; and the map of features as the list of its entries.
"""

import re
from typing import Any

from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

PACKAGE = "scenefactory.womd"  # of these messages in their own pool: generated modules may have the same names
CHOICE = "feature_data"  # the name of MapFeature's oneof, which is written before each of its fields
LAYOUT = """
message Scenario {
  repeated double timestamps_seconds = 1; int32 current_time_index = 10; bytes scenario_id = 5;
  repeated Track tracks = 2; int32 sdc_track_index = 6; repeated int32 objects_of_interest = 4;
  repeated RequiredPrediction tracks_to_predict = 11;
  repeated DynamicMapState dynamic_map_states = 7;
  repeated MapFeature map_features = 8;
}
message Track { int32 id = 1; int32 object_type = 2; repeated ObjectState states = 3; }
message ObjectState {
  double center_x = 2; double center_y = 3; double center_z = 4;
  float length = 5; float width = 6; float height = 7;
  float heading = 8; float velocity_x = 9; float velocity_y = 10; bool valid = 11;
}
message RequiredPrediction { int32 track_index = 1; int32 difficulty = 2; }
message DynamicMapState { repeated TrafficSignalLaneState lane_states = 1; }
message TrafficSignalLaneState { int64 lane = 1; int32 state = 2; MapPoint stop_point = 3; }
message MapFeature {
  int64 id = 1;
  oneof LaneCenter lane = 3; oneof RoadLine road_line = 4; oneof RoadEdge road_edge = 5; oneof StopSign stop_sign = 7;
  oneof Crosswalk crosswalk = 8; oneof SpeedBump speed_bump = 9; oneof Driveway driveway = 10;
}
message MapPoint { double x = 1; double y = 2; double z = 3; }
message LaneCenter {
  double speed_limit_mph = 1; int32 type = 2; repeated MapPoint polyline = 8;
  repeated int64 entry_lanes = 9; repeated int64 exit_lanes = 10;
  repeated LaneNeighbor left_neighbors = 11; repeated LaneNeighbor right_neighbors = 12;
}
message LaneNeighbor { int64 feature_id = 1; }
message RoadLine { int32 type = 1; repeated MapPoint polyline = 2; }
message RoadEdge { int32 type = 1; repeated MapPoint polyline = 2; }
message StopSign { repeated int64 lane = 1; MapPoint position = 2; }
message Crosswalk { repeated MapPoint polygon = 1; }
message SpeedBump { repeated MapPoint polygon = 1; }
message Driveway { repeated MapPoint polygon = 1; }

message Example { Features features = 1; }
message Features { repeated FeatureEntry feature = 1; }
message FeatureEntry { bytes key = 1; Feature value = 2; }
message Feature { BytesList bytes_list = 1; FloatList float_list = 2; Int64List int64_list = 3; }
message BytesList { repeated bytes value = 1; }
message FloatList { repeated float value = 1; }
message Int64List { repeated int64 value = 1; }
"""


def _build(layout: str) -> list[Any]:
    """The classes of the two messages that records hold."""
    file = FileDescriptorProto(name="womd.proto", package=PACKAGE, syntax="proto2")
    for name, fields in re.findall(r"message (\w+) \{(.*?)\}", layout, re.DOTALL):
        message = file.message_type.add(name=name)
        for label, kind, field, number in re.findall(r"(repeated |oneof )?(\w+) (\w+) = (\d+);", fields):
            entry = message.field.add(name=field, number=int(number))
            entry.label = FieldDescriptorProto.LABEL_REPEATED if label == "repeated " else FieldDescriptorProto.LABEL_OPTIONAL
            if kind[0].isupper():
                entry.type, entry.type_name = FieldDescriptorProto.TYPE_MESSAGE, f".{PACKAGE}.{kind}"
            else:
                entry.type = FieldDescriptorProto.Type.Value(f"TYPE_{kind.upper()}")
            if label == "oneof ":
                entry.oneof_index = 0
                if not message.oneof_decl:
                    message.oneof_decl.add(name=CHOICE)
    pool = DescriptorPool()
    pool.AddSerializedFile(file.SerializeToString())
    return [GetMessageClass(pool.FindMessageTypeByName(f"{PACKAGE}.{name}")) for name in ("Scenario", "Example")]


Scenario, Example = _build(LAYOUT)
