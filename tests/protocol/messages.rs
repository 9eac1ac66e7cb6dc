//! Golden text messages: one file per request and per answer.

use serde_json::{Value, json};
use wildcity_protocol::camera::{Exposure, Lens, Shutter, ShutterDirection};
use wildcity_protocol::decode::decode;
use wildcity_protocol::error::Code;
use wildcity_protocol::message::*;
use wildcity_protocol::{PROTOCOL, http};

use super::{check_json, read};

#[test]
fn requests_are_the_golden_ones() {
    for (name, request) in requests() {
        let file = format!("vectors/requests/{name}.json");
        check_json(&file, &request);
        assert_eq!(serde_json::from_slice::<Request>(&read(&file)).unwrap(), request, "{name}");
    }
}

#[test]
fn answers_are_the_golden_ones() {
    for (name, answer) in answers() {
        let file = format!("vectors/answers/{name}.json");
        check_json(&file, &answer);
        assert_eq!(serde_json::from_slice::<Answer>(&read(&file)).unwrap(), answer, "{name}");
    }
}

#[test]
fn pushes_are_the_golden_ones() {
    let (asked, answered) = (new_push(), push());
    check_json("vectors/http/new_push_capture.json", &asked);
    check_json("vectors/http/push_capture.json", &answered);
    let text = String::from_utf8(read("vectors/http/new_push_capture.json")).unwrap();
    assert_eq!(decode::<http::NewPush>(&text).as_ref(), Ok(&asked));
    let answer = read("vectors/http/push_capture.json");
    assert_eq!(serde_json::from_slice::<http::Push>(&answer).unwrap(), answered);
    let wrong = decode::<http::NewPush>(&text.replace("\"capture\"", "\"world\"")).unwrap_err();
    assert_eq!(wrong.mistake.field.as_deref(), Some("frame"));
}

#[test]
fn absent_fields_have_defaults() {
    let open = Request::Open(Box::new(Open { seq: 1, ..Open::twin("street") }));
    let parse = |text: &str| serde_json::from_str::<Request>(text);
    assert_eq!(parse(r#"{"type":"open","seq":1,"twin":"street"}"#).unwrap(), open);
    let pose = r#""pose":{"xyz":[0,0,0],"q":[1,0,0,0]}"#;
    let step = parse(&format!(r#"{{"type":"step","seq":2,{pose}}}"#)).unwrap();
    assert!(matches!(step, Request::Step { terminate: false, .. }));
    let reset = parse(r#"{"type":"reset","seq":3}"#).unwrap();
    let expected =
        Request::Reset { seq: 3, session: None, seed: 0, start: None, dynamics: None, speed: None };
    assert_eq!(reset, expected);
    // Unknown fields of requests are mistakes, not extensions.
    let unknown = format!(r#"{{"type":"step","seq":2,{pose},"speed":3}}"#);
    assert!(parse(&unknown).unwrap_err().to_string().contains("speed"));
}

/// A newer server may add fields, at any depth.
#[test]
fn answers_with_unknown_fields_are_the_same_answers() {
    for (name, answer) in answers() {
        let mut more: Value =
            serde_json::from_slice(&read(&format!("vectors/answers/{name}.json"))).unwrap();
        add_unknown_fields(&mut more);
        assert_eq!(serde_json::from_value::<Answer>(more).unwrap(), answer, "{name}");
    }
}

/// Adds a field to every object, except `profile`, `period_us`, and `cameras` and `lidars` of sensors: they
/// are maps, so any field is known.
pub(crate) fn add_unknown_fields(value: &mut Value) {
    match value {
        Value::Object(fields) => {
            for (name, inner) in &mut *fields {
                match (name.as_str(), inner) {
                    ("profile" | "period_us", _) => {}
                    ("cameras" | "lidars", Value::Object(by_name)) => {
                        by_name.values_mut().for_each(add_unknown_fields);
                    }
                    (_, inner) => add_unknown_fields(inner),
                }
            }
            fields.insert("since_next_year".to_owned(), json!([1, "x"]));
        }
        Value::Array(items) => items.iter_mut().for_each(add_unknown_fields),
        _ => {}
    }
}

/// The server reads every golden request, and no request with a field more.
#[test]
fn golden_requests_are_decoded_strictly() {
    for (name, request) in requests() {
        let text = String::from_utf8(read(&format!("vectors/requests/{name}.json"))).unwrap();
        assert_eq!(decode::<Request>(&text).as_ref(), Ok(&request), "{name}");
    }
    let file = read("vectors/requests/open.json");
    for (pointer, path) in [
        ("", "speed"),
        ("/outputs", "outputs.speed"),
        ("/rig/cameras/1", "rig.cameras[1].speed"),
        ("/rig/cameras/0/camera_to_rig", "rig.cameras[0].camera_to_rig.speed"),
    ] {
        let mut sent: Value = serde_json::from_slice(&file).unwrap();
        sent.pointer_mut(pointer).unwrap()["speed"] = 3.into();
        let refused = decode::<Request>(&sent.to_string()).unwrap_err();
        assert_eq!((refused.seq, refused.mistake.field.as_deref()), (Some(1), Some(path)));
    }
}

/// Every schema of messages of clients can be read.
#[test]
fn every_inbound_schema_has_shapes() {
    let digest = format!("blake3:{}", blake3::hash(b"x"));
    let upload = json!({ "name": "a", "size": 1e3, "digest": digest });
    assert_eq!(decode::<http::NewUpload>(&upload.to_string()).unwrap().size, 1000);
    assert_eq!(decode::<http::Rollback>(r#"{"version": 3}"#).unwrap().version, 3);
    let push = r#"{"files": [{"upload": "x"}], "cells": "all", "golden": {"min_psnr_db": 20}}"#;
    assert_eq!(decode::<http::NewPush>(push).unwrap().files.len(), 1);
    let listed = push.replace("\"all\"", "[[0, 0], [1, -1.0]]");
    assert!(matches!(
        decode::<http::NewPush>(&listed).unwrap().cells,
        Some(http::CellSelection::Listed(cells)) if cells == [[0, 0], [1, -1]]
    ));
    let wrong = decode::<http::NewPush>(&push.replace("\"all\"", "\"some\"")).unwrap_err();
    assert_eq!(wrong.mistake.field.as_deref(), Some("cells"));
}

fn pose(xyz: [f64; 3], q: [f64; 4]) -> Pose {
    Pose { xyz, q }
}

pub(crate) fn front() -> RigCamera {
    RigCamera {
        name: "front".into(),
        width: 4,
        height: 3,
        fx: Some(3.5),
        fy: Some(3.5),
        cx: 2.0,
        cy: 1.5,
        lens: None,
        windshield: None,
        shutter: None,
        exposure: None,
        overlay: None,
        native_size: None,
        camera_to_rig: pose([1.6, 0.0, 1.5], [0.5, -0.5, 0.5, -0.5]),
    }
}

pub(crate) fn rear() -> RigCamera {
    RigCamera {
        name: "rear".into(),
        lens: Some(Lens::Fisheye { k: [-0.03, -0.005, -0.001, 0.001], max_angle: Some(1.2) }),
        shutter: Some(Shutter { direction: ShutterDirection::TopToBottom, duration_us: 30_000 }),
        exposure: Some(Exposure {
            matrix: Some([[1.25, 0.0, 0.0], [0.0, 1.125, -0.0625], [0.0, 0.0, 1.5]]),
            gain: None,
            offset: [0.0, -0.03125, 0.0],
        }),
        camera_to_rig: pose([-0.9, 0.0, 1.4], [0.5, -0.5, -0.5, 0.5]),
        ..front()
    }
}

/// Every effect of sensors.
fn sensors() -> Sensors {
    let camera = CameraSensor {
        drop: Some(0.125),
        late: Some(LateFrames { chance: 0.25, by_us: 100_000 }),
        freeze: Some(FrozenFrames { chance: 0.0625, for_us: 1_000_000 }),
        noise: Some(ImageNoise { full_well: 5000.0, read: 8.0 }),
        exposure: Some(ExposureDrift { stops: 0.25, period_us: 2_000_000 }),
        dirt: Some(LensDirt { spots: 12, radius: 0.03125, opacity: 0.75 }),
    };
    let axis = |noise, bias| Some(AxisNoise { noise, bias });
    Sensors {
        lidars: [("top".to_owned(), LidarSensor { noise_m: Some(0.03125), drop: None })].into(),
        cameras: [("front".to_owned(), camera)].into(),
        imu: Some(Imu {
            accelerometer: axis(0.03125, 0.0625),
            gyroscope: axis(0.0078125, 0.00390625),
            bias_period_us: Some(60_000_000),
        }),
        wheel_speed: Some(WheelSpeed { noise: 0.0625, scale: 0.015625 }),
        delay_us: Some(200_000),
    }
}

fn top() -> RigLidar {
    RigLidar {
        name: "top".into(),
        beams: LidarBeams {
            row_elevations_rad: vec![0.125, 0.0, -0.25],
            row_azimuth_offsets_rad: Some(vec![0.0, 0.015625, -0.015625]),
            column_azimuths_rad: None,
            columns: Some(LidarColumns { count: 1_800, first_rad: 3.125, last_rad: -3.125 }),
            duration_us: 100_000,
            min_range_m: Some(0.5),
            max_range_m: Some(120.0),
        },
        lidar_to_rig: Pose { xyz: [1.25, 0.0, 1.875], q: [1.0, 0.0, 0.0, 0.0] },
    }
}

fn requests() -> Vec<(&'static str, Request)> {
    let station = Start::Station { trajectory: "log".into(), station_m: 12.5 };
    let seen = RigCamera {
        exposure: Some(Exposure { matrix: None, gain: Some([1.5, 1.0, 0.75]), offset: [0.0; 3] }),
        overlay: Some("data:image/png;base64,aG9vZA==".into()),
        native_size: Some([8.0, 6.5]),
        ..front()
    };
    let rig = Rig { name: "pair".into(), cameras: vec![seen, rear()], lidars: vec![top()] };
    let section = DriveSection {
        name: "log".into(),
        from_m: Some(12.5),
        to_m: Some(62.5),
        every_m: Some(0.5),
    };
    let open = Open {
        seq: 1,
        version: Some(3),
        session: Some("run-17".into()),
        seed: 42,
        start: Some(station.clone()),
        rig: Some(RigChoice::Full(rig)),
        outputs: Outputs {
            cameras: Some(vec!["front".into(), "rear".into()]),
            images: [(
                "front".to_owned(),
                ImagePart { crop: Some([1, 0, 3, 3]), size: Some([6, 6]) },
            )]
            .into(),
            encoding: Encoding::Raw,
            quality: Some(85),
            depth: true,
            opacity: true,
            normals: Some(true),
            instances: Some(true),
            semantics: Some(true),
            frames: Some(4),
            trust: Some(true),
            actors: None,
            period_us: Some([("rear".to_owned(), 200_000)].into()),
        },
        dt_us: Some(100_000),
        deadline_ms: Some(20_000),
        decision_us: Some(500_000),
        scenario: None,
        warm_up_us: Some(1_600_000),
        trajectory: Some(section),
        ..Open::twin("street")
    };
    let preset = Open {
        seq: 1,
        rig: Some(RigChoice::Preset("vehicle6".into())),
        profile: [("tau_px".to_owned(), 2.0.into())].into_iter().collect(),
        ..Open::twin("street")
    };
    let dynamics = Dynamics { model: DynamicsModel::Dynamic, speed: 8.25, reverse: true };
    let driven =
        Open { seq: 1, dynamics: Some(DynamicsChoice::Full(dynamics)), ..Open::twin("street") };
    let model = Some(DynamicsChoice::Model(DynamicsModel::Kinematic));
    let model = Open { seq: 1, dynamics: model, ..Open::twin("street") };
    let repair = Repair {
        model: "zero-dce".into(),
        below: Some(0.625),
        above: Some(0.875),
        at_least: Some(0.125),
        per_step: Some(4),
        on_failure: Some(OnFailure::Error),
    };
    let repaired = Open { seq: 1, repair: Some(repair), ..Open::twin("street") };
    let sensed = Open { seq: 1, sensors: Some(sensors()), ..Open::twin("street") };
    let step = |seq, pose, trajectory, action, terminate| Request::Step {
        seq,
        session: None,
        pose,
        trajectory,
        action,
        until_us: None,
        notes: None,
        terminate,
    };
    let ahead =
        |time_us, x_m| TimedPose { time_us, pose: pose([x_m, 0.5, 0.0], [1.0, 0.0, 0.0, 0.0]) };
    let until = Request::Step {
        seq: 3,
        session: None,
        pose: None,
        trajectory: Some(vec![ahead(500_000, 1.5), ahead(1_000_000, 3.25)]),
        action: None,
        until_us: Some(1_000_000),
        notes: Some(json!({ "confidence": 0.75, "reasoning": "a clear road" })),
        terminate: false,
    };
    let planned = vec![ahead(100_000, 1.5), ahead(200_000, 3.25)];
    let action = Action { acceleration: -1.5, curvature: 0.025 };
    let there = pose([12.5, -3.25, 0.125], [0.8, 0.0, 0.0, 0.6]);
    let above = pose([12.5, -3.25, 30.0], [1.0, 0.0, 0.0, 0.0]);
    let start = Start::Pose { pose: there };
    let client = ClientInfo { name: "golden".into(), version: "0.1.0".into() };
    let protocols = vec![PROTOCOL.to_owned()];
    let reset = |seq, seed, start| Request::Reset {
        seq,
        session: None,
        seed,
        start,
        dynamics: None,
        speed: None,
    };
    let random = RandomStart {
        trajectory: Some("log".into()),
        from_m: Some(20.0),
        to_m: Some(300.0),
        lateral_m: Some(0.5),
        heading_rad: Some(0.0625),
    };
    let dynamics = Dynamics { model: DynamicsModel::Kinematic, speed: 3.0, reverse: false };
    let drawn = Request::Reset {
        seq: 8,
        session: None,
        seed: 10,
        start: Some(Start::Random { random }),
        dynamics: Some(DynamicsChoice::Full(dynamics)),
        speed: Some(8.5),
    };
    let resume = |also| Request::Resume { seq: 1, session: "run-17".into(), last_seq: 4, also };
    let alone = SessionStep {
        session: "run-17".into(),
        pose: Some(there),
        trajectory: None,
        action: None,
        until_us: None,
        notes: None,
        terminate: false,
    };
    let many = vec![
        alone.clone(),
        SessionStep {
            session: "run-18".into(),
            pose: None,
            action: Some(action),
            until_us: Some(200_000),
            notes: Some(json!({ "confidence": 0.75 })),
            terminate: true,
            ..alone
        },
    ];
    let taken =
        BranchPoint::Snapshot { session: "run-17".into(), snapshot: "before-junction".into() };
    let recorded = BranchPoint::Recorded { episode: "run-17-1".into(), step: 40 };
    vec![
        ("hello", Request::Hello { seq: 0, client, protocols }),
        ("share_memory", Request::ShareMemory { seq: 1, proof: None }),
        ("share_memory_proof", Request::ShareMemory { seq: 2, proof: Some("5f1c0e64".repeat(4)) }),
        ("open", Request::Open(Box::new(open))),
        ("open_preset", Request::Open(Box::new(preset))),
        ("open_dynamics", Request::Open(Box::new(driven))),
        ("open_model", Request::Open(Box::new(model))),
        ("open_repair", Request::Open(Box::new(repaired))),
        ("open_sensors", Request::Open(Box::new(sensed))),
        ("step", step(3, Some(there), None, None, false)),
        ("step_terminate", step(4, Some(there), None, None, true)),
        ("step_trajectory", step(3, None, Some(planned), None, false)),
        ("step_action", step(3, None, None, Some(action), false)),
        ("step_until", until),
        ("observe", Request::Observe { seq: 5, session: None, poses: vec![there, above] }),
        ("prefetch", Request::Prefetch { seq: 6, session: None, poses: vec![there, above] }),
        ("reset", reset(2, 7, None)),
        ("reset_pose", reset(6, 8, Some(start))),
        ("reset_station", reset(7, 9, Some(station))),
        ("reset_random", drawn),
        ("switch_version", Request::SwitchVersion { seq: 8, session: None, version: Some(4) }),
        ("switch_latest", Request::SwitchVersion { seq: 8, session: None, version: None }),
        ("snapshot", Request::Snapshot { seq: 9, session: None, name: "before-junction".into() }),
        ("restore", Request::Restore { seq: 10, session: None, name: "before-junction".into() }),
        ("branch", Request::Branch(Branch { seq: 1, from: taken, session: Some("run-18".into()) })),
        ("branch_recorded", Request::Branch(Branch { seq: 1, from: recorded, session: None })),
        ("close", Request::Close { seq: 8, session: None }),
        ("close_named", Request::Close { seq: 8, session: Some("run-17".into()) }),
        ("resume", resume(Vec::new())),
        ("resume_also", resume(vec!["run-18".into()])),
        ("step_many", Request::StepMany { seq: 3, steps: many }),
    ]
}

/// A push of files in the axes of the capture.
fn new_push() -> http::NewPush {
    let file = http::PushFile {
        upload: "blake3-0".into(),
        axes: Some("y-down-z-forward".into()),
        scale: Some(1.0),
        name: None,
    };
    http::NewPush {
        id: Some("epoch-30".into()),
        files: vec![file],
        frame: Some(http::PushFrame::Capture),
        base: Some(3),
        cells: None,
        record: None,
        levels: true,
        profile: Vec::new(),
        note: Some("epoch 30".into()),
        preview: http::PreviewRequest::default(),
        drop_bad: false,
    }
}

/// The answer once it is ready: the base was aligned.
fn push() -> http::Push {
    let report = http::PushReport {
        gaussians: 120_000,
        frame: Some(http::PushFrame::Capture),
        aligned: true,
        cells: vec![http::CellReport { cell: [0, 0], before: 100_000, after: 120_000 }],
        ..http::PushReport::default()
    };
    http::Push {
        id: "epoch-30".into(),
        twin: "city".into(),
        state: http::PushState::Ready,
        progress: http::Progress { done: 0, total: 0 },
        version: Some(4),
        version_hash: Some(blake3::hash(b"a manifest").to_hex().to_string()),
        report: Some(report),
        error: None,
    }
}

/// Two poses of a drive.
pub(crate) fn drive() -> Drive {
    let at = |station_m: f64, time_us, x_m| DrivePose {
        station_m,
        time_us,
        pose: pose([x_m, -3.25, 0.125], [0.8, 0.0, 0.0, 0.6]),
    };
    Drive {
        name: "log".into(),
        version: 3,
        version_hash: blake3::hash(b"a manifest").to_hex().to_string(),
        length_m: 350.5,
        poses: vec![at(12.5, 1_250_000, 12.5), at(13.0, 1_300_000, 13.0)],
    }
}

fn answers() -> Vec<(&'static str, Answer)> {
    let trajectory = TrajectoryInfo { name: "log".into(), length_m: 350.5, keyframes: 702 };
    let version_hash = blake3::hash(b"a manifest").to_hex().to_string();
    let profile_hash = blake3::hash(b"a profile").to_hex().to_string();
    let twin = TwinInfo {
        name: "street".into(),
        version: 3,
        version_hash: version_hash.clone(),
        gaussians: 300_000,
        sh_degree: 1,
        trajectories: vec![trajectory.clone()],
    };
    let welcome = Answer::Welcome {
        seq: 0,
        protocol: PROTOCOL.into(),
        server: ServerInfo { name: "wildcity".into(), version: "0.1.0".into() },
        limits: Limits {
            message_bytes: 1_048_576,
            observe_poses: 16,
            cameras: 16,
            side_px: 16_384,
            answer_pixels: 134_217_728,
            idle_ms: 600_000,
            resume_ms: 60_000,
        },
        backend: "cpu".into(),
        twins: vec![twin],
        repairs: Vec::new(),
    };
    let profile = json!({"alpha_cap": 0.99, "antialiased": false, "near": 0.01});
    let opened = Opened {
        seq: 1,
        session: "run-17".into(),
        twin: "street".into(),
        version: 3,
        version_hash,
        profile_hash,
        profile: profile.as_object().unwrap().clone(),
        backend: "cpu".into(),
        seed: 42,
        start: pose([12.5, -3.25, 0.125], [0.8, 0.0, 0.0, 0.6]),
        dynamics: Dynamics { model: DynamicsModel::Dynamic, speed: 8.25, reverse: true },
        dt_us: 100_000,
        deadline_ms: 20_000,
        decision_us: 500_000,
        warm_up_us: 1_600_000,
        cameras: vec![front(), rear()],
        lidars: Vec::new(),
        outputs: Outputs {
            encoding: Encoding::Raw,
            depth: true,
            opacity: true,
            frames: Some(4),
            trust: Some(true),
            actors: None,
            period_us: Some([("front".to_owned(), 100_000), ("rear".to_owned(), 200_000)].into()),
            ..Outputs::default()
        },
        trajectories: vec![trajectory],
        reserved_bytes: 36_000_000,
        repair: None,
        sensors: None,
        scenario: None,
        semantics: None,
        trajectory: Some(drive()),
    };
    let sensed = Opened {
        trajectory: None,
        sensors: Some(sensors()),
        lidars: vec![OpenedLidar {
            name: "top".into(),
            rows: 64,
            columns: 1_800,
            duration_us: 100_000,
            min_range_m: 0.5,
            max_range_m: 200.0,
            lidar_to_rig: pose([1.25, 0.0, 1.875], [1.0, 0.0, 0.0, 0.0]),
        }],
        ..opened.clone()
    };
    let classes = ["none", "unlabelled", "road"].map(str::to_owned).to_vec();
    let labelled = Opened {
        trajectory: None,
        semantics: Some(OpenedSemantics { labelled: true, classes }),
        ..opened.clone()
    };
    let repaired = Opened {
        trajectory: None,
        repair: Some(OpenedRepair {
            model: "zero-dce".into(),
            version: "1".into(),
            repair_hash: blake3::hash(b"a model").to_hex().to_string(),
            provider: "cpu".into(),
            deterministic: true,
            below: 0.625,
            above: 0.875,
            at_least: 0.125,
            per_step: 4,
            on_failure: OnFailure::Error,
            references: Some(ReferenceSource::Rendered),
        }),
        ..opened.clone()
    };
    let switched = Answer::Switched {
        seq: 8,
        version: 4,
        version_hash: opened.version_hash.clone(),
        profile_hash: opened.profile_hash.clone(),
        profile: opened.profile.clone(),
    };
    let resumed = Answer::Resumed {
        seq: 1,
        session: "run-17".to_owned(),
        last_seq: 4,
        step: 2,
        time_us: 200_000,
        opened: Some(Box::new(Opened { trajectory: None, ..opened.clone() })),
        also: Vec::new(),
    };
    let other = ResumedSession {
        session: "run-18".to_owned(),
        step: 3,
        time_us: 300_000,
        opened: Box::new(Opened {
            session: "run-18".to_owned(),
            trajectory: None,
            ..opened.clone()
        }),
    };
    let resumed_also = Answer::Resumed {
        seq: 1,
        session: "run-17".to_owned(),
        last_seq: 4,
        step: 2,
        time_us: 200_000,
        opened: Some(Box::new(Opened { trajectory: None, ..opened.clone() })),
        also: vec![other],
    };
    let summary = Summary {
        outcome: Outcome::OffModel,
        steps: 2,
        time_us: 200_000,
        distance_m: 1.75,
        least_trust: Some(0.0625),
        episode: Some("agent-1".into()),
    };
    let refused = Answer::Error {
        seq: Some(3),
        code: Code::PoseNotFinite,
        message: "q[2] is NaN; a pose needs finite numbers".into(),
        field: Some("pose.q[2]".into()),
        fatal: false,
    };
    let fatal = Answer::Error {
        seq: None,
        code: Code::ShuttingDown,
        message:
            "the server is shutting down, and its sessions end: open a new one when it is back"
                .into(),
        field: None,
        fatal: true,
    };
    let shared_memory = Answer::SharedMemory {
        seq: 1,
        path: "/proc/4242/fd/17".into(),
        target: "/memfd:wildcity-c161acb4065fb456 (deleted)".into(),
        proof_bytes: 32,
        slots: 3,
        slot_bytes: 1_610_612_736,
    };
    let in_memory = Answer::InMemory { seq: 5, slot: 1, offset: 1_610_612_736, bytes: 20_077_000 };
    let mut offering = welcome.clone();
    if let Answer::Welcome { repairs, .. } = &mut offering {
        repairs.extend(["deblur".to_owned(), "zero-dce".to_owned()]);
    }
    vec![
        ("welcome", welcome),
        ("welcome_repairs", offering),
        ("opened", Answer::Opened(Box::new(opened))),
        ("opened_repair", Answer::Opened(Box::new(repaired))),
        ("opened_sensors", Answer::Opened(Box::new(sensed))),
        ("opened_semantics", Answer::Opened(Box::new(labelled))),
        ("resumed", resumed),
        ("resumed_also", resumed_also),
        ("ok", Answer::Ok { seq: 6 }),
        ("switched", switched),
        ("shared_memory", shared_memory),
        ("in_memory", in_memory),
        ("closed", Answer::Closed { seq: 8, summary }),
        ("error", refused),
        ("error_fatal", fatal),
    ]
}
