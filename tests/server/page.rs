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

fn page() -> String {
    std::fs::read_to_string(crate::root::root().join("protocol/README.md")).unwrap()
}
