//! Answers reuse the memory of earlier answers, whose contents must not appear in them.

use std::sync::Arc;

use serde_json::Value;
use wildcity_scene::geometry::camera::Fisheye;
use wildcity_scene::geometry::{Camera, camera::Lens};
use wildcity_session::{Encoding, PixelMaps, RigChoice, SessionOptions};

use crate::actors::{actors, car, open, options};
use crate::driving::{Bench, bench, bench_with};
use crate::streaming::{demo, unlimited};

const ALL_MAPS: PixelMaps =
    PixelMaps { depth: true, opacity: true, normals: true, instances: true };

/// Sessions whose answers have about the same size and different contents; one has a lens whose
/// field ends within the image.
fn sessions() -> Vec<SessionOptions> {
    let of = |encoding: Encoding, maps: PixelMaps, frames: u64| {
        let mut asked = options(&actors(&Value::from(&*car().hash)), false);
        asked.outputs.encoding = encoding;
        asked.outputs.maps = maps;
        asked.outputs.frames = Some(frames);
        asked
    };
    let fisheye = |mut asked: SessionOptions| {
        if let Some(RigChoice::Full(rig)) = &mut asked.rig {
            let camera = &mut rig.cameras[0].camera;
            let lens = Lens::Fisheye(Fisheye::new([0.0; 4], Some(0.4)));
            *camera = Camera { lens, ..*camera };
        }
        asked
    };
    let depth = PixelMaps { depth: true, ..PixelMaps::default() };
    vec![
        of(Encoding::Raw, ALL_MAPS, 1),
        fisheye(of(Encoding::Raw, ALL_MAPS, 1)),
        of(Encoding::Png, ALL_MAPS, 1),
        of(Encoding::Raw, depth, 3),
        fisheye(of(Encoding::Jpeg(90), depth, 1)),
        of(Encoding::Raw, PixelMaps::default(), 3),
    ]
}

/// The bytes of the first three observations of a session.
async fn observations(bench: &Bench, name: &str, options: SessionOptions) -> Vec<Vec<u8>> {
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
