//! The definitions of ROS 2's messages, as its packages have them (`common_interfaces` and
//! `geometry2`, without their comments).

/// A message with its definition.
struct Definition {
    name: &'static str,
    fields: &'static str,
    /// Other messages that the fields are of.
    uses: &'static [&'static str],
}

const TIME: &str = "builtin_interfaces/Time";
const HEADER: &str = "std_msgs/Header";
const VECTOR: &str = "geometry_msgs/Vector3";
const POINT: &str = "geometry_msgs/Point";
const QUATERNION: &str = "geometry_msgs/Quaternion";
const POSE: &str = "geometry_msgs/Pose";
const TWIST: &str = "geometry_msgs/Twist";

const DEFINITIONS: &[Definition] = &[
    Definition { name: TIME, fields: "int32 sec\nuint32 nanosec\n", uses: &[] },
    Definition {
        name: HEADER,
        fields: "builtin_interfaces/Time stamp\nstring frame_id\n",
        uses: &[TIME],
    },
    Definition { name: VECTOR, fields: "float64 x\nfloat64 y\nfloat64 z\n", uses: &[] },
    Definition { name: POINT, fields: "float64 x\nfloat64 y\nfloat64 z\n", uses: &[] },
    Definition {
        name: QUATERNION,
        fields: "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
        uses: &[],
    },
    Definition {
        name: POSE,
        fields: "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
        uses: &[POINT, QUATERNION],
    },
    Definition {
        name: "geometry_msgs/PoseStamped",
        fields: "std_msgs/Header header\ngeometry_msgs/Pose pose\n",
        uses: &[HEADER, POSE],
    },
    Definition {
        name: "geometry_msgs/PoseWithCovariance",
        fields: "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
        uses: &[POSE],
    },
    Definition {
        name: TWIST,
        fields: "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
        uses: &[VECTOR],
    },
    Definition {
        name: "geometry_msgs/TwistWithCovariance",
        fields: "geometry_msgs/Twist twist\nfloat64[36] covariance\n",
        uses: &[TWIST],
    },
    Definition {
        name: "geometry_msgs/Transform",
        fields: "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
        uses: &[VECTOR, QUATERNION],
    },
    Definition {
        name: "geometry_msgs/TransformStamped",
        fields: "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n",
        uses: &[HEADER, "geometry_msgs/Transform"],
    },
    Definition {
        name: "sensor_msgs/RegionOfInterest",
        fields: "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n",
        uses: &[],
    },
    Definition {
        name: "sensor_msgs/CompressedImage",
        fields: "std_msgs/Header header\nstring format\nuint8[] data\n",
        uses: &[HEADER],
    },
    Definition {
        name: "sensor_msgs/PointField",
        fields: "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\n\
                 uint8 UINT32=6\nuint8 FLOAT32=7\nuint8 FLOAT64=8\nstring name\nuint32 offset\n\
                 uint8 datatype\nuint32 count\n",
        uses: &[],
    },
    Definition {
        name: "sensor_msgs/PointCloud2",
        fields: "std_msgs/Header header\nuint32 height\nuint32 width\n\
                 sensor_msgs/PointField[] fields\nbool is_bigendian\nuint32 point_step\n\
                 uint32 row_step\nuint8[] data\nbool is_dense\n",
        uses: &[HEADER, "sensor_msgs/PointField"],
    },
    Definition {
        name: "sensor_msgs/CameraInfo",
        fields: "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\n\
                 float64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\n\
                 uint32 binning_y\nsensor_msgs/RegionOfInterest roi\n",
        uses: &[HEADER, "sensor_msgs/RegionOfInterest"],
    },
    Definition {
        name: "tf2_msgs/TFMessage",
        fields: "geometry_msgs/TransformStamped[] transforms\n",
        uses: &["geometry_msgs/TransformStamped"],
    },
    Definition {
        name: "nav_msgs/Odometry",
        fields: "std_msgs/Header header\nstring child_frame_id\n\
                 geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist\n",
        uses: &[HEADER, "geometry_msgs/PoseWithCovariance", "geometry_msgs/TwistWithCovariance"],
    },
    Definition {
        name: "nav_msgs/Path",
        fields: "std_msgs/Header header\ngeometry_msgs/PoseStamped[] poses\n",
        uses: &[HEADER, "geometry_msgs/PoseStamped"],
    },
    Definition {
        name: "rosgraph_msgs/Clock",
        fields: "builtin_interfaces/Time clock\n",
        uses: &[TIME],
    },
];

/// The definition of a message with those of all messages in it, as MCAP's `ros2msg` has them.
/// `name` is `PACKAGE/msg/NAME`.
pub(super) fn definition(name: &str) -> String {
    let mut names = vec![name.replace("/msg/", "/")];
    let mut text = String::new();
    let mut next = 0;
    // Breadth first; a message is defined once.
    while let Some(name) = names.get(next).cloned() {
        let found = DEFINITIONS.iter().find(|definition| definition.name == name);
        let Some(Definition { name, fields, uses }) = found else { break };
        if next > 0 {
            text += &format!("{}\nMSG: {name}\n", "=".repeat(80));
        }
        text += fields;
        for used in *uses {
            if !names.iter().any(|name| name == used) {
                names.push((*used).to_owned());
            }
        }
        next += 1;
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_definition_has_all_that_it_uses() {
        for Definition { name, fields, uses } in DEFINITIONS {
            let types = fields.lines().filter_map(|line| line.split_once(' '));
            for (kind, _) in types.filter(|(kind, _)| kind.contains('/')) {
                let kind = kind.trim_end_matches("[]");
                assert!(uses.contains(&kind), "{name}: {kind}");
                assert!(DEFINITIONS.iter().any(|other| other.name == kind), "{kind}");
            }
        }
        let clock = definition("rosgraph_msgs/msg/Clock");
        let line = "=".repeat(80);
        let time = "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n";
        assert_eq!(clock, format!("builtin_interfaces/Time clock\n{line}\n{time}"));
    }
}
