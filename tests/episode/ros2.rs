//! Export for ROS 2: what a reader finds, and the bytes of its messages.

use std::collections::BTreeMap;
use std::io::Cursor;

use wildcity_episode::{ExportedImage, Ros2Export};
use wildcity_scene::Rig;

use crate::written::Made;

/// The numbers of a message, read in their order.
struct Cdr<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Cdr<'a> {
    fn new(message: &'a [u8]) -> Self {
        assert_eq!(message[..4], [0, 1, 0, 0], "little endian, plain");
        Self { bytes: &message[4..], at: 0 }
    }

    fn take<const N: usize>(&mut self) -> [u8; N] {
        self.at = self.at.next_multiple_of(N);
        let bytes = self.bytes[self.at..self.at + N].try_into().unwrap();
        self.at += N;
        bytes
    }

    fn u32(&mut self) -> u32 {
        u32::from_le_bytes(self.take())
    }

    fn f64(&mut self) -> f64 {
        f64::from_le_bytes(self.take())
    }

    fn bytes(&mut self) -> &'a [u8] {
        let len = self.u32() as usize;
        self.at += len;
        &self.bytes[self.at - len..self.at]
    }

    fn text(&mut self) -> &'a str {
        std::str::from_utf8(self.bytes()).unwrap().strip_suffix('\0').unwrap()
    }
}

fn exported() -> Vec<u8> {
    let episode = Made { steps: 20, plan_poses: 4, ..Made::default() }.read();
    let rig = Rig::preset("vehicle6").unwrap();
    let mut bytes = Cursor::new(Vec::new());
    let mut export = Ros2Export::begin(&episode, Some(&rig), &mut bytes).unwrap();
    for time_us in [0, 1_000_000] {
        export.image(&ExportedImage { camera: 1, time_us, jpeg: b"jpeg of it" }).unwrap();
    }
    export.finish().unwrap();
    bytes.into_inner()
}

#[test]
fn a_reader_finds_messages_of_ros_2() {
    let bytes = exported();
    let mut counts: BTreeMap<(String, String), u32> = BTreeMap::new();
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let message = message.unwrap();
        let schema = message.channel.schema.as_ref().unwrap();
        assert_eq!((&*schema.encoding, &*message.channel.message_encoding), ("ros2msg", "cdr"));
        let latched = message.channel.metadata.contains_key("offered_qos_profiles");
        assert_eq!(latched, message.channel.topic == "/tf_static");
        *counts.entry((message.channel.topic.clone(), schema.name.clone())).or_default() += 1;
    }
    let count = |topic: &str, schema: &str| counts[&(topic.to_owned(), schema.to_owned())];
    assert_eq!(count("/clock", "rosgraph_msgs/msg/Clock"), 21);
    assert_eq!(count("/tf", "tf2_msgs/msg/TFMessage"), 21);
    assert_eq!(count("/tf_static", "tf2_msgs/msg/TFMessage"), 1);
    assert_eq!(count("/odometry", "nav_msgs/msg/Odometry"), 21);
    assert_eq!(count("/plan", "nav_msgs/msg/Path"), 20);
    assert_eq!(count("/camera/front_left/camera_info", "sensor_msgs/msg/CameraInfo"), 3);
    assert_eq!(count("/camera/rear/camera_info", "sensor_msgs/msg/CameraInfo"), 1);
    let images = count("/camera/front_left/compressed", "sensor_msgs/msg/CompressedImage");
    assert_eq!((images, counts.len()), (2, 5 + 6 + 1));
}

#[test]
fn messages_have_their_fields_in_order() {
    let bytes = exported();
    let first = |topic: &str| {
        let all = mcap::MessageStream::new(&bytes).unwrap().map(|message| message.unwrap());
        all.into_iter().find(|message| message.channel.topic == topic).unwrap().data.to_vec()
    };
    let image = first("/camera/front_left/compressed");
    let mut cdr = Cdr::new(&image);
    assert_eq!((cdr.u32(), cdr.u32()), (1_000, 0));
    assert_eq!((cdr.text(), cdr.text()), ("front_left_optical_frame", "jpeg"));
    assert_eq!((cdr.bytes(), cdr.at), (&b"jpeg of it"[..], image.len() - 4));

    let camera = Rig::preset("vehicle6").unwrap().cameras[1].camera;
    let info = first("/camera/front_left/camera_info");
    let mut cdr = Cdr::new(&info);
    assert_eq!((cdr.u32(), cdr.u32(), cdr.text()), (1_000, 0, "front_left_optical_frame"));
    assert_eq!((cdr.u32(), cdr.u32()), (camera.height_px, camera.width_px));
    assert_eq!(cdr.text(), "plumb_bob");
    let d: Vec<f64> = (0..cdr.u32()).map(|_| cdr.f64()).collect();
    assert_eq!(d, [0.0; 5]);
    let k: Vec<f64> = (0..9).map(|_| cdr.f64()).collect();
    // ROS counts pixels from the middle of the first one.
    assert_eq!([k[0], k[2]], [camera.pinhole.fx, camera.pinhole.cx - 0.5]);
    // R and P.
    assert!((0..21).all(|_| cdr.f64().is_finite()));
    assert_eq!([0; 6].map(|_: u32| cdr.u32()), [0; 6]);
    assert_eq!(cdr.take::<1>(), [0]);
    assert_eq!(cdr.at, info.len() - 4);

    let mounts = first("/tf_static");
    let mut cdr = Cdr::new(&mounts);
    assert_eq!((cdr.u32(), cdr.u32(), cdr.u32()), (6, 1_000, 0));
    assert_eq!((cdr.text(), cdr.text()), ("base_link", "front_optical_frame"));
    let mounted = Rig::preset("vehicle6").unwrap().cameras[0].rig_from_camera;
    assert_eq!([0.0; 3].map(|_| cdr.f64()), mounted.position_m.to_array());
    // The scalar is last.
    assert_eq!([0.0; 4].map(|_| cdr.f64()), mounted.rotation.to_array());
}
