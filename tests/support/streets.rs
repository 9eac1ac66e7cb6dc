//! Scenes shaped like a street: flat and thin Gaussians, near and far.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use glam::DVec3;
use wildcity_generate::StreetSettings;
use wildcity_render::View;
use wildcity_scene::{Gaussians, Rig, sh};

use crate::images::view_along;
use crate::scene_files::Random;

/// `n` Gaussians of a road, two facades and clutter along +z, y down (a camera's own axes).
pub(crate) fn street(n: usize, sh_degree: u8, seed: u64) -> Gaussians {
    let mut random = Random(seed);
    let mut g = Gaussians::with_capacity(sh_degree, n);
    for i in 0..n {
        let z = 150.0 * random.unit();
        let (mean, scale) = match i % 10 {
            0..=2 => ([16.0 * random.unit() - 8.0, 1.6, z], [0.08, 0.01, 0.08]),
            3..=7 => {
                let side = if random.unit() < 0.5 { -1.0 } else { 1.0 };
                let x = side * (8.0 + 0.6 * random.unit());
                ([x, 1.6 - 14.0 * random.unit(), z], [0.01, 0.1, 0.1])
            }
            _ => {
                let x = 18.0 * random.unit() - 9.0;
                ([x, 1.6 - 6.0 * random.unit(), z], [0.06; 3])
            }
        };
        g.means_m.push(mean);
        g.quats_wxyz
            .push([1.0, 0.0, 0.0, 0.0].map(|q: f64| (q + 0.2 * random.unit() - 0.1) as f32));
        g.ln_scales.push(scale.map(|s: f64| (s.ln() + random.unit() - 0.5) as f32));
        g.logit_opacities.push(random.between(-2.0, 4.0));
        g.sh.extend((0..3).map(|_| random.between(-1.5, 1.5)));
        g.sh.extend((3..3 * sh::coefficients(sh_degree)).map(|_| random.between(-0.3, 0.3)));
    }
    g
}

/// Six views from within a street, all around, of six sizes.
pub(crate) fn turning_views() -> Vec<View> {
    (0..6)
        .map(|i| {
            let yaw = f64::from(i);
            let forward = DVec3::new(yaw.sin(), 0.0, yaw.cos());
            view_along([150 + 7 * i, 90], 110.0, DVec3::new(0.0, 0.0, 30.0), forward, DVec3::Y)
        })
        .collect()
}

/// Views from within a street: along it, across it, and back.
pub(crate) fn street_views() -> [View; 3] {
    let at = DVec3::new(0.4, 0.0, 20.0);
    [
        view_along([200, 131], 240.0, at, DVec3::new(0.1, 0.02, 1.0), DVec3::Y),
        view_along([131, 100], 90.0, at, DVec3::new(1.0, 0.1, 0.3), DVec3::Y),
        view_along([97, 64], 60.0, at, DVec3::new(-0.4, 0.0, -1.0), DVec3::new(0.2, 1.0, 0.0)),
    ]
}

/// The demo street, and the views of two of its cameras at an eighth of their size.
pub(crate) fn demo_street() -> (Gaussians, [View; 2]) {
    let street = wildcity_generate::street(&StreetSettings::default()).unwrap();
    let rig = Rig::preset("vehicle6").unwrap();
    let world_from_rig = street.trajectory.at_station(60.0);
    let view = |name: &str| {
        let mounted = rig.cameras.iter().find(|camera| camera.name == name).unwrap();
        let (width_px, height_px) = (mounted.camera.width_px / 8, mounted.camera.height_px / 8);
        let eighth = mounted.camera.scaled(width_px.into(), height_px.into()).unwrap();
        View::new(eighth, world_from_rig * mounted.rig_from_camera)
    };
    let views = [view("front"), view("left")];
    (street.gaussians, views)
}
