//! protocol/README.md states the limits of the program.

/// The numbers on the page are those of the program.
#[test]
fn limits_are_those_of_the_configuration() {
    let page = page();
    let poses = wildcity_protocol::limits::HISTORY_POSES;
    let seconds = |limit: std::time::Duration| limit.as_secs();
    for row in [
        format!("| `ego.history_xyz` | F32 [{poses}, 3] |"),
        format!("| `ego.history_rot` | F32 [{poses}, 3, 3] |"),
        format!("| poses of one `observe` | {} |", wildcity_session::limits::OBSERVE_POSES),
        format!("| poses of one `prefetch` | {} |", wildcity_session::limits::PREFETCH_POSES),
        format!("| poses of one `trajectory` | {} |", wildcity_sim::limits::PATH_POSES),
        format!("| time of a `trajectory` | {} s |", wildcity_sim::limits::PATH_US / 1_000_000),
        format!(
            "±{} m/s², and curvature of the rear axle's path, ±{} 1/m",
            wildcity_sim::limits::EGO_ACCELERATION_M_S2,
            wildcity_sim::limits::EGO_CURVATURE_1_M
        ),
        format!("by at most {:.2} rad", wildcity_sim::limits::EGO_STEERING_RAD),
        format!("Both are limited to {} m/s", wildcity_sim::limits::EGO_SPEED_M_S),
        format!("drive backwards, at most {} m/s", wildcity_sim::limits::EGO_REVERSE_M_S),
        format!("recorded drive within {} m", wildcity_sim::limits::GROUND_NEAR_M),
        format!("| cameras of a rig | {} |", wildcity_scene::Rig::MAX_CAMERAS),
        format!(
            "| message to the server | {} MiB |",
            wildcity_protocol::limits::INBOUND_MESSAGE_BYTES >> 20
        ),
        format!(
            "| `hello` after connecting | {} s |",
            seconds(wildcity_protocol::limits::HELLO_TIMEOUT)
        ),
        format!(
            "| silence between requests | {} s |",
            seconds(wildcity_server::limits::IDLE_TIMEOUT)
        ),
        format!("| reading an answer | {} s |", seconds(wildcity_protocol::limits::SEND_TIMEOUT)),
        format!("| resuming | {} s |", seconds(wildcity_server::limits::RESUME_GRACE)),
        format!("hears nothing for {} s", seconds(wildcity_client::limits::ANSWER_TIMEOUT)),
        format!("headers up to {} MiB", wildcity_protocol::limits::OBSERVATION_HEADER_BYTES >> 20),
        format!(
            "| uploads kept, and their bytes | {}, {} GiB |",
            wildcity_server::limits::UPLOADS,
            wildcity_server::limits::SPOOL_BYTES >> 30
        ),
        format!("| one upload | {} GiB |", wildcity_server::limits::UPLOAD_BYTES >> 30),
        format!(
            "| silence within an upload | {} s |",
            seconds(wildcity_server::limits::UPLOAD_SILENCE)
        ),
        format!(
            "| age of an abandoned upload | {} h |",
            seconds(wildcity_server::limits::UPLOAD_AGE) / 3600
        ),
        format!("| pushes that wait or run | {} |", wildcity_push::limits::OPEN_PUSHES),
        format!("| files of a push | {} |", wildcity_push::limits::PUSH_FILES),
        format!("| poses compared | {} |", wildcity_push::limits::PREVIEW_MAX_POSES),
        format!(
            "frames up to {} GiB",
            wildcity_protocol::limits::OBSERVATION_BYTES as f64 / f64::from(1 << 30)
        ),
    ] {
        assert!(page.contains(&row), "{row}");
    }
    let pixels =
        page.split("all images together | ").nth(1).and_then(|rest| rest.split(' ').next());
    let pixels = pixels.map(|pixels| pixels.replace(',', ""));
    assert_eq!(pixels, Some(wildcity_session::limits::ANSWER_PIXELS.to_string()));
}

/// The ranges and counts in the schema of requests are those of the program.
#[test]
fn ranges_of_the_schema_are_those_of_the_program() {
    use wildcity_session::limits as session;
    use wildcity_sim::limits as sim;
    let text = std::fs::read_to_string(crate::root::root().join("protocol/schema/request.json"));
    let schema: serde_json::Value = serde_json::from_str(&text.unwrap()).unwrap();
    let request = |name: &str| {
        let variants = schema["oneOf"].as_array().unwrap().iter();
        let variant = variants.clone().find(|v| v["properties"]["type"]["const"] == name);
        variant.unwrap_or_else(|| panic!("no request {name}"))["properties"].clone()
    };
    let definition = |name: &str| schema["$defs"][name]["properties"].clone();
    let side = f64::from(wildcity_scene::geometry::Camera::MAX_SIDE_PX);
    let shutter_us = wildcity_scene::geometry::camera::Shutter::MAX_US as f64;
    let cameras = wildcity_scene::Rig::MAX_CAMERAS as f64;
    let most_us = session::BUNDLE_PERIOD_US as f64;
    let dt_us = [session::DT_MIN_US as f64, session::DT_MAX_US as f64];
    let coordinate_m = wildcity_scene::geometry::Pose::MAX_COORDINATE_M;
    let range = ["minimum", "maximum"];
    let items = ["minItems", "maxItems"];
    for (field, keywords, limits) in [
        (&request("open")["dt_us"], range, dt_us),
        (&request("open")["decision_us"], range, [dt_us[0], most_us]),
        (&request("open")["warm_up_us"], range, [0.0, session::WARM_UP_US as f64]),
        (&request("observe")["poses"], items, [1.0, session::OBSERVE_POSES as f64]),
        (&request("prefetch")["poses"], items, [1.0, session::PREFETCH_POSES as f64]),
        (&request("step")["trajectory"], items, [1.0, sim::PATH_POSES as f64]),
        (&definition("TimedPose")["time_us"], range, [1.0, sim::PATH_US as f64]),
        (
            &definition("Action")["acceleration"],
            range,
            [-sim::EGO_ACCELERATION_M_S2, sim::EGO_ACCELERATION_M_S2],
        ),
        (
            &definition("Action")["curvature"],
            range,
            [-sim::EGO_CURVATURE_1_M, sim::EGO_CURVATURE_1_M],
        ),
        (&definition("Dynamics")["speed"], range, [-sim::EGO_REVERSE_M_S, sim::EGO_SPEED_M_S]),
        (&definition("Outputs")["frames"], range, [1.0, session::BUNDLE_FRAMES as f64]),
        (&definition("Rig")["cameras"], items, [1.0, cameras]),
        (&definition("RigCamera")["width"], range, [1.0, side]),
        (&definition("Shutter")["duration_us"], range, [1.0, shutter_us]),
        (&request("step")["until_us"], range, [dt_us[0], session::PLAN_US as f64]),
        (&definition("SessionStep")["until_us"], range, [dt_us[0], session::PLAN_US as f64]),
        (&request("reset")["speed"], range, [-sim::EGO_REVERSE_M_S, sim::EGO_SPEED_M_S]),
        (&definition("RandomStart")["lateral_m"], range, [0.0, session::START_LATERAL_M]),
        (&definition("RandomStart")["heading_rad"], range, [0.0, std::f64::consts::PI]),
        (&definition("Outputs")["period_us"]["additionalProperties"], range, [dt_us[0], most_us]),
        (&definition("ImagePart")["size"]["items"], range, [1.0, side]),
        (&definition("Pose")["xyz"]["items"], range, [-coordinate_m, coordinate_m]),
        (&definition("Sensors")["delay_us"], range, [0.0, most_us]),
        (&definition("LensDirt")["spots"], range, [1.0, session::DIRT_SPOTS as f64]),
        (
            &definition("Imu")["bias_period_us"],
            range,
            [*session::DRIFT_PERIOD_US.start() as f64, *session::DRIFT_PERIOD_US.end() as f64],
        ),
    ] {
        let found = keywords.map(|keyword| field[keyword].as_f64());
        assert_eq!(found, limits.map(Some), "{field}");
    }
    // Names: the pattern accepts what the program accepts.
    let pattern = "^[a-z0-9_-][a-z0-9._-]{0,63}$";
    assert_eq!(request("open")["twin"]["pattern"], pattern);
    for name in [
        "step",
        "observe",
        "prefetch",
        "reset",
        "switch_version",
        "snapshot",
        "restore",
        "close",
        "resume",
        "open",
        "branch",
    ] {
        assert_eq!(request(name)["session"]["pattern"], pattern, "{name}");
    }
    assert_eq!(request("resume")["also"]["items"]["pattern"], pattern);
    assert_eq!(definition("SessionStep")["session"]["pattern"], pattern);
    for (name, is_name) in
        [("a", true), (".a", false), ("-", true), ("a.b_c-9", true), ("A", false)]
    {
        assert_eq!(wildcity_scene::rig::is_name(name), is_name, "{name}");
    }
    assert_eq!(wildcity_scene::rig::MAX_NAME_BYTES, 64);
}

/// docs/cameras.md lists the cameras of every preset, in their order.
#[test]
fn presets_have_the_cameras_of_the_page() {
    let page = std::fs::read_to_string(crate::root::root().join("docs/cameras.md")).unwrap();
    for preset in wildcity_scene::Rig::preset_names() {
        let rig = wildcity_scene::Rig::preset(preset).unwrap();
        let names: Vec<_> = rig.cameras.iter().map(|camera| format!("`{}`", camera.name)).collect();
        let row = format!("| {} |", names.join(", "));
        let line = page.lines().find(|line| line.starts_with(&format!("| `{preset}`")));
        assert!(line.is_some_and(|line| line.ends_with(&row)), "{preset}: {line:?}, not {row}");
    }
}

fn page() -> String {
    std::fs::read_to_string(crate::root::root().join("protocol/README.md")).unwrap()
}
