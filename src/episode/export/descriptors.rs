//! The protobuf descriptors of Foxglove's messages, which an MCAP file contains in addition to the
//! messages.
//!
//! Source of names and numbers: foxglove/schemas, `schemas/proto/foxglove`. All fields are
//! included, because a viewer may look for fields that episodes leave empty. The exceptions are the
//! identifier and the lineage of an image.

use prost::Message as _;
use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{
    DescriptorProto, EnumDescriptorProto, EnumValueDescriptorProto, FieldDescriptorProto,
    FileDescriptorProto, FileDescriptorSet,
};

/// Fields of a message: name, number, type. `[]` before a type repeats it, `.` begins the full name
/// of a message, and `=` that of an enum.
type Fields = &'static [(&'static str, i32, &'static str)];

const MESSAGES: &[(&str, Fields)] = &[
    ("Vector3", &[("x", 1, "double"), ("y", 2, "double"), ("z", 3, "double")]),
    ("Velocity3", &[("x", 1, "double"), ("y", 2, "double"), ("z", 3, "double")]),
    ("Point3", &[("x", 1, "double"), ("y", 2, "double"), ("z", 3, "double")]),
    (
        "Quaternion",
        &[("x", 1, "double"), ("y", 2, "double"), ("z", 3, "double"), ("w", 4, "double")],
    ),
    ("Color", &[("r", 1, "double"), ("g", 2, "double"), ("b", 3, "double"), ("a", 4, "double")]),
    ("Pose", &[("position", 1, ".foxglove.Vector3"), ("orientation", 2, ".foxglove.Quaternion")]),
    ("KeyValuePair", &[("key", 1, "string"), ("value", 2, "string")]),
    (
        "FrameTransform",
        &[
            ("timestamp", 1, TIMESTAMP),
            ("parent_frame_id", 2, "string"),
            ("child_frame_id", 3, "string"),
            ("translation", 4, ".foxglove.Vector3"),
            ("rotation", 5, ".foxglove.Quaternion"),
        ],
    ),
    ("FrameTransforms", &[("transforms", 1, "[].foxglove.FrameTransform")]),
    (
        "PoseInFrame",
        &[("timestamp", 1, TIMESTAMP), ("frame_id", 2, "string"), ("pose", 3, ".foxglove.Pose")],
    ),
    (
        "PosesInFrame",
        &[("timestamp", 1, TIMESTAMP), ("frame_id", 2, "string"), ("poses", 3, "[].foxglove.Pose")],
    ),
    (
        "ArrowPrimitive",
        &[
            ("pose", 1, ".foxglove.Pose"),
            ("shaft_length", 2, "double"),
            ("shaft_diameter", 3, "double"),
            ("head_length", 4, "double"),
            ("head_diameter", 5, "double"),
            ("color", 6, ".foxglove.Color"),
        ],
    ),
    ("CubePrimitive", SOLID),
    ("SpherePrimitive", SOLID),
    (
        "CylinderPrimitive",
        &[
            ("pose", 1, ".foxglove.Pose"),
            ("size", 2, ".foxglove.Vector3"),
            ("bottom_scale", 3, "double"),
            ("top_scale", 4, "double"),
            ("color", 5, ".foxglove.Color"),
        ],
    ),
    (
        "LinePrimitive",
        &[
            ("type", 1, "=foxglove.LineType"),
            ("pose", 2, ".foxglove.Pose"),
            ("thickness", 3, "double"),
            ("scale_invariant", 4, "bool"),
            ("points", 5, "[].foxglove.Point3"),
            ("color", 6, ".foxglove.Color"),
            ("colors", 7, "[].foxglove.Color"),
            ("indices", 8, "[]fixed32"),
        ],
    ),
    (
        "TriangleListPrimitive",
        &[
            ("pose", 1, ".foxglove.Pose"),
            ("points", 2, "[].foxglove.Point3"),
            ("color", 3, ".foxglove.Color"),
            ("colors", 4, "[].foxglove.Color"),
            ("indices", 5, "[]fixed32"),
        ],
    ),
    (
        "TextPrimitive",
        &[
            ("pose", 1, ".foxglove.Pose"),
            ("billboard", 2, "bool"),
            ("font_size", 3, "double"),
            ("scale_invariant", 4, "bool"),
            ("color", 5, ".foxglove.Color"),
            ("text", 6, "string"),
        ],
    ),
    (
        "ModelPrimitive",
        &[
            ("pose", 1, ".foxglove.Pose"),
            ("scale", 2, ".foxglove.Vector3"),
            ("color", 3, ".foxglove.Color"),
            ("override_color", 4, "bool"),
            ("url", 5, "string"),
            ("media_type", 6, "string"),
            ("data", 7, "bytes"),
        ],
    ),
    (
        "SceneEntity",
        &[
            ("timestamp", 1, TIMESTAMP),
            ("frame_id", 2, "string"),
            ("id", 3, "string"),
            ("lifetime", 4, ".google.protobuf.Duration"),
            ("frame_locked", 5, "bool"),
            ("metadata", 6, "[].foxglove.KeyValuePair"),
            ("arrows", 7, "[].foxglove.ArrowPrimitive"),
            ("cubes", 8, "[].foxglove.CubePrimitive"),
            ("spheres", 9, "[].foxglove.SpherePrimitive"),
            ("cylinders", 10, "[].foxglove.CylinderPrimitive"),
            ("lines", 11, "[].foxglove.LinePrimitive"),
            ("triangles", 12, "[].foxglove.TriangleListPrimitive"),
            ("texts", 13, "[].foxglove.TextPrimitive"),
            ("models", 14, "[].foxglove.ModelPrimitive"),
        ],
    ),
    (
        "SceneEntityDeletion",
        &[
            ("timestamp", 1, TIMESTAMP),
            ("type", 2, "=foxglove.SceneEntityDeletionType"),
            ("id", 3, "string"),
        ],
    ),
    (
        "SceneUpdate",
        &[
            ("deletions", 1, "[].foxglove.SceneEntityDeletion"),
            ("entities", 2, "[].foxglove.SceneEntity"),
        ],
    ),
    (
        "Odometry",
        &[
            ("timestamp", 1, TIMESTAMP),
            ("frame_id", 2, "string"),
            ("child_frame_id", 3, "string"),
            ("pose", 4, ".foxglove.Pose"),
            ("linear_velocity", 5, ".foxglove.Velocity3"),
            ("angular_velocity", 6, ".foxglove.Velocity3"),
            ("pose_covariance", 7, "[]double"),
            ("velocity_covariance", 8, "[]double"),
        ],
    ),
    (
        "CompressedImage",
        &[
            ("timestamp", 1, TIMESTAMP),
            ("frame_id", 4, "string"),
            ("data", 2, "bytes"),
            ("format", 3, "string"),
        ],
    ),
    (
        "CameraCalibration",
        &[
            ("timestamp", 1, TIMESTAMP),
            ("frame_id", 9, "string"),
            ("width", 2, "fixed32"),
            ("height", 3, "fixed32"),
            ("distortion_model", 4, "string"),
            ("D", 5, "[]double"),
            ("K", 6, "[]double"),
            ("R", 7, "[]double"),
            ("P", 8, "[]double"),
        ],
    ),
    (
        "PackedElementField",
        &[("name", 1, "string"), ("offset", 2, "fixed32"), ("type", 3, "=foxglove.NumericType")],
    ),
    (
        "PointCloud",
        &[
            ("timestamp", 1, TIMESTAMP),
            ("frame_id", 2, "string"),
            ("pose", 3, ".foxglove.Pose"),
            ("point_stride", 4, "fixed32"),
            ("fields", 5, "[].foxglove.PackedElementField"),
            ("data", 6, "bytes"),
        ],
    ),
    (
        "Log",
        &[
            ("timestamp", 1, TIMESTAMP),
            ("level", 2, "=foxglove.LogLevel"),
            ("message", 3, "string"),
            ("name", 4, "string"),
            ("file", 5, "string"),
            ("line", 6, "fixed32"),
        ],
    ),
];

const TIMESTAMP: &str = ".google.protobuf.Timestamp";

const SOLID: Fields = &[
    ("pose", 1, ".foxglove.Pose"),
    ("size", 2, ".foxglove.Vector3"),
    ("color", 3, ".foxglove.Color"),
];

const ENUMS: &[(&str, &[&str])] = &[
    // Values share one space of names, so that this `UNKNOWN` has a longer one than Foxglove's.
    (
        "NumericType",
        &[
            "UNKNOWN_NUMBER",
            "UINT8",
            "INT8",
            "UINT16",
            "INT16",
            "UINT32",
            "INT32",
            "FLOAT32",
            "FLOAT64",
        ],
    ),
    ("LineType", &["LINE_STRIP", "LINE_LOOP", "LINE_LIST"]),
    ("SceneEntityDeletionType", &["MATCHING_ID", "ALL"]),
    ("LogLevel", &["UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL"]),
];

/// The descriptors of all messages, as an MCAP schema has them.
pub(super) fn descriptor_set() -> Vec<u8> {
    let seconds_and_nanos = &[("seconds", 1, "int64"), ("nanos", 2, "int32")];
    let google = |file: &str, name: &str| FileDescriptorProto {
        name: Some(format!("google/protobuf/{file}.proto")),
        package: Some("google.protobuf".to_owned()),
        syntax: Some("proto3".to_owned()),
        message_type: vec![message(name, seconds_and_nanos)],
        ..FileDescriptorProto::default()
    };
    let foxglove = FileDescriptorProto {
        name: Some("foxglove/episode.proto".to_owned()),
        package: Some("foxglove".to_owned()),
        syntax: Some("proto3".to_owned()),
        dependency: ["timestamp", "duration"]
            .map(|f| format!("google/protobuf/{f}.proto"))
            .to_vec(),
        message_type: MESSAGES.iter().map(|(name, fields)| message(name, fields)).collect(),
        enum_type: ENUMS.iter().map(|(name, values)| enumeration(name, values)).collect(),
        ..FileDescriptorProto::default()
    };
    // A file comes after those that it depends on, as readers resolve them in order.
    let file = vec![google("timestamp", "Timestamp"), google("duration", "Duration"), foxglove];
    FileDescriptorSet { file }.encode_to_vec()
}

fn message(name: &str, fields: &[(&str, i32, &str)]) -> DescriptorProto {
    let field = |(name, number, of): &(&str, i32, &str)| {
        // `[]` stands before all other marks of a type.
        let (label, of) = match of.strip_prefix("[]") {
            Some(of) => (Label::Repeated, of),
            None => (Label::Optional, *of),
        };
        let (kind, type_name) = match (of, of.strip_prefix('=')) {
            (_, Some(of)) => (Type::Enum, Some(format!(".{of}"))),
            ("double", _) => (Type::Double, None),
            ("string", _) => (Type::String, None),
            ("bool", _) => (Type::Bool, None),
            ("bytes", _) => (Type::Bytes, None),
            ("fixed32", _) => (Type::Fixed32, None),
            ("int64", _) => (Type::Int64, None),
            ("int32", _) => (Type::Int32, None),
            // What is left is the full name of a message, with the `.` at its start that protobuf
            // expects.
            (of, None) => (Type::Message, Some(of.to_owned())),
        };
        FieldDescriptorProto {
            name: Some((*name).to_owned()),
            number: Some(*number),
            label: Some(label.into()),
            r#type: Some(kind.into()),
            type_name,
            ..FieldDescriptorProto::default()
        }
    };
    DescriptorProto {
        name: Some(name.to_owned()),
        field: fields.iter().map(field).collect(),
        ..DescriptorProto::default()
    }
}

fn enumeration(name: &str, values: &[&str]) -> EnumDescriptorProto {
    // Foxglove's enums count from 0 in order, so that the index is the number. The longest has nine
    // values.
    let value = |(number, value): (usize, &&str)| EnumValueDescriptorProto {
        name: Some((**value).to_owned()),
        number: Some(number as i32),
        ..EnumValueDescriptorProto::default()
    };
    EnumDescriptorProto {
        name: Some(name.to_owned()),
        value: values.iter().enumerate().map(value).collect(),
        ..EnumDescriptorProto::default()
    }
}
