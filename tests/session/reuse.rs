//! Answers reuse the memory of earlier answers, whose contents must not appear in them.

use std::sync::Arc;

use serde_json::Value;
use wildcity_session::options::camera::Lens;
use wildcity_session::options::{Encoding, Open, Outputs, RigChoice};

use crate::actors::{actors, car, open, options};
use crate::driving::{Bench, bench, bench_with};
use crate::streaming::{demo, unlimited};

/// Depth, opacity, normals, instances and semantics.
const ALL_MAPS: [bool; 5] = [true; 5];

/// Sessions whose answers have about the same size and different contents; one has a lens whose
/// field ends within the image.
fn sessions() -> Vec<Open> {
    let of = |encoding: Encoding, maps: [bool; 5], frames: u64| {
        let [depth, opacity, normals, instances, semantics] = maps;
        let mut asked = options(&actors(&Value::from(&*car().hash)), false);
        asked.outputs = Outputs {
            quality: Some(90),
            depth,
            opacity,
            normals: Some(normals),
            instances: Some(instances),
            semantics: Some(semantics),
            frames: Some(frames),
            ..Outputs::colour(encoding)
        };
        asked
    };
    let fisheye = |mut asked: Open| {
        if let Some(RigChoice::Full(rig)) = &mut asked.rig {
            rig.cameras[0].lens = Some(Lens::Fisheye { k: [0.0; 4], max_angle: Some(0.4) });
        }
        asked
    };
    let depth = [true, false, false, false, false];
    vec![
        of(Encoding::Raw, ALL_MAPS, 1),
        fisheye(of(Encoding::Raw, ALL_MAPS, 1)),
        of(Encoding::Png, ALL_MAPS, 1),
        of(Encoding::Raw, depth, 3),
        fisheye(of(Encoding::Jpeg, depth, 1)),
        of(Encoding::Raw, [false; 5], 3),
    ]
}

/// The bytes of the first three observations of a session.
async fn observations(bench: &Bench, name: &str, options: Open) -> Vec<Vec<u8>> {
    let mut session = open(bench, name, options).await;
    let mut seen = vec![session.reset(0, None).await.unwrap().buffer.bytes().to_vec()];
    for station_m in [101.0, 102.0] {
        let observation = session.step(demo().at(station_m), false).await.unwrap();
        seen.push(observation.buffer.bytes().to_vec());
    }
    seen
}

#[tokio::test(flavor = "multi_thread")]
async fn observations_do_not_depend_on_those_of_other_sessions() {
    let shared = bench(unlimited());
    for round in 0..2 {
        for (index, options) in sessions().into_iter().enumerate() {
            let name = format!("{round}-{index}");
            let among_others = observations(&shared, &name, options.clone()).await;
            // Its buffers are zeroed, and those of the others hold other values before the backend
            // writes them.
            let fresh = bench_with(unlimited(), Arc::new(crate::images::cpu()));
            let alone = observations(&fresh, &name, options).await;
            assert!(among_others == alone, "{name}");
        }
    }
}
