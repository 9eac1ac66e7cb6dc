//! Pictures of an actor: from ahead on the left, from the right, from behind, and from above.

use std::io::Cursor;
use std::sync::Arc;

use glam::DVec3;
use image::{ImageFormat, RgbImage};

use wildcity_render::View;
use wildcity_render::compare::images::{render_images, view_along};
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_scene::actor::{ActorAsset, PlacedChunk};
use wildcity_scene::geometry::Pose;
use wildcity_scene::{ActorBox, RenderProfile, Scene};

/// Size of one of four pictures, in pixels.
const SIZE_PX: [u32; 2] = [640, 400];
/// Focal length, in pixels: 53° wide.
const FOCAL_PX: f64 = 640.0;

/// Renders the four pictures as one PNG.
pub(super) fn draw_all_around(asset: &ActorAsset) -> anyhow::Result<Vec<u8>> {
    let ActorBox { length_m, width_m, height_m } = asset.description.box_;
    let middle_m = DVec3::new(0.0, 0.0, 0.5 * height_m);
    // Far enough for its length across a picture, and for its height.
    let away_m = (1.25 * length_m.hypot(width_m).hypot(height_m)).max(2.0 * height_m).max(0.1);
    let toward = [(0.9, 0.8, 0.35), (0.05, -1.0, 0.15), (-1.0, -0.25, 0.3), (-0.5, 0.6, 0.9)];
    let views = toward.map(|(x, y, z)| {
        let side = DVec3::new(x, y, z).normalize();
        view_along(SIZE_PX, FOCAL_PX, middle_m + away_m * side, -side, DVec3::NEG_Z)
    });
    let [width, height] = SIZE_PX;
    let mut all = RgbImage::new(2 * width, 2 * height);
    for (index, own) in render(asset, &views)?.into_iter().enumerate() {
        let index = index as i64;
        let at = [index % 2 * i64::from(width), index / 2 * i64::from(height)];
        image::imageops::replace(&mut all, &own, at[0], at[1]);
    }
    png(&all)
}

/// Renders the actor's right side as a vehicle's front camera sees it: 1440 x 928 px, a focal
/// length of 1800 px, 1.5 m above the ground, and `distance_m` from the side of the box.
pub(super) fn draw_side(asset: &ActorAsset, distance_m: f64) -> anyhow::Result<Vec<u8>> {
    let aside_m = 0.5 * asset.description.box_.width_m + distance_m;
    let position_m = DVec3::new(0.0, -aside_m, 1.5);
    let view = view_along([1440, 928], 1800.0, position_m, DVec3::Y, DVec3::NEG_Z);
    png(&render(asset, &[view])?.remove(0))
}

fn render(asset: &ActorAsset, views: &[View]) -> anyhow::Result<Vec<RgbImage>> {
    let chunk = Arc::clone(&asset.levels[0].chunk);
    let scene =
        Scene { placed: vec![PlacedChunk::at_rest(chunk, Pose::IDENTITY, 0)], ..Scene::default() };
    let profile = RenderProfile { background: [0.55; 3], ..RenderProfile::default() };
    let images = render_images(&Cpu::new(0, Simd::Best)?, &scene, &profile, views)?;
    let sized = images.into_iter().zip(views).map(|(image, view)| {
        let own = RgbImage::from_raw(view.camera.width_px, view.camera.height_px, image.rgb8);
        own.ok_or_else(|| anyhow::anyhow!("an image has another size"))
    });
    sized.collect()
}

fn png(image: &RgbImage) -> anyhow::Result<Vec<u8>> {
    let mut png = Cursor::new(Vec::new());
    image.write_to(&mut png, ImageFormat::Png)?;
    Ok(png.into_inner())
}
