//! Which pixels a warp takes, to the pixel: images of noise before a wall, so that a shift by half
//! a pixel is seen.

use std::sync::Arc;

use glam::{DQuat, DVec3};
use wildcity_repair::Image;
use wildcity_repair::reference::{Projection, Rays, Reference, WarpTarget, Warped, warp};
use wildcity_scene::geometry::camera::Pinhole;
use wildcity_scene::geometry::{Camera, Pose};

use crate::support::picture;

const WIDTH: usize = 83;
const HEIGHT: usize = 47;
const FOCAL_PX: f64 = 64.0;
const WALL_M: f64 = 8.0;
/// A place in UTM.
const FAR_M: DVec3 = DVec3::new(431_000.0, 5_412_000.0, 300.0);

fn camera() -> Camera {
    let pinhole = Pinhole { fx: FOCAL_PX, fy: FOCAL_PX, cx: 41.0, cy: 23.0 };
    Camera::from_pinhole(WIDTH as u32, HEIGHT as u32, pinhole)
}

/// Values that differ from pixel to pixel.
fn noise() -> Image {
    let mut image = picture(WIDTH, HEIGHT);
    for (at, value) in image.rgb8.iter_mut().enumerate() {
        *value = ((at * 7919) % 251) as u8;
    }
    image
}

fn reference(image: Image, depth_m: Vec<f32>, world_from_camera: Pose) -> Arc<Reference> {
    let projection = Arc::new(Projection::from_camera(&camera()));
    Arc::new(Reference { image, depth_m, projection, world_from_camera })
}

fn wall() -> Vec<f32> {
    vec![WALL_M as f32; WIDTH * HEIGHT]
}

fn warped(depth_m: &[f32], world_from_camera: Pose, references: &[Arc<Reference>]) -> Warped {
    let camera = camera();
    let rays = Rays::from_camera(&camera);
    let target =
        WarpTarget { camera: &camera, rays: &rays, world_from_camera, shutter: None, depth_m };
    warp(&target, references)
}

fn moved(x_m: f64, y_m: f64, z_m: f64) -> Pose {
    Pose { position_m: DVec3::new(x_m, y_m, z_m), ..Pose::IDENTITY }
}

#[test]
fn from_the_same_place_each_pixel_is_itself_up_to_the_border() {
    let turned = DQuat::from_rotation_z(1.1) * DQuat::from_rotation_x(-0.4);
    for pose in [Pose::IDENTITY, Pose { position_m: FAR_M, rotation: turned }] {
        let depth_m: Vec<f32> = (0..WIDTH * HEIGHT).map(|at| 2.0 + (at * 31 % 97) as f32).collect();
        let own = reference(noise(), depth_m.clone(), pose);
        let warped = warped(&depth_m, pose, &[own]);
        assert!(warped.valid.iter().all(|valid| *valid == 1.0));
        assert_eq!(warped.pixels, [WIDTH * HEIGHT]);
        let image = noise();
        let pairs = warped.image.rgb8.iter().zip(&image.rgb8);
        assert_eq!(pairs.filter(|(a, b)| a.abs_diff(**b) > 1).count(), 0);
    }
}

#[test]
fn colours_are_mixed_of_four_pixels_and_what_is_outside_is_not_valid() {
    // So many pixels to the right and down are the points of a pixel in the reference.
    for [right, down] in [[0.25, 0.0], [0.75, -0.625], [-0.375, 0.875], [2.5, 3.5]] {
        let per_m = WALL_M / FOCAL_PX;
        // Far from the origin: differences of poses are taken in f64.
        let target = Pose { position_m: FAR_M, ..Pose::IDENTITY };
        let pose = moved(-right * per_m, -down * per_m, 0.0);
        let pose = Pose { position_m: FAR_M + pose.position_m, ..pose };
        let own = reference(noise(), wall(), pose);
        let warped = warped(&wall(), target, &[own]);
        let image = noise();
        let mut outside = 0;
        for at in 0..WIDTH * HEIGHT {
            let u = (at % WIDTH) as f64 + 0.5 + right;
            let v = (at / WIDTH) as f64 + 0.5 + down;
            let is_within = u >= 0.0 && v >= 0.0 && u < WIDTH as f64 && v < HEIGHT as f64;
            assert_eq!(warped.valid[at] > 0.0, is_within, "{u} {v}");
            let rgb = &warped.image.rgb8[3 * at..][..3];
            if !is_within {
                assert_eq!(rgb, [0, 0, 0]);
                outside += 1;
                continue;
            }
            for (channel, value) in rgb.iter().enumerate() {
                let exact = mixed(&image, u, v, channel);
                assert!((f64::from(*value) - exact).abs() < 0.6, "{u} {v}: {value}, not {exact}");
            }
        }
        assert_eq!(outside > 0, right.abs().max(down.abs()) > 0.5, "{right} {down}");
    }
}

/// Between the middles of four pixels, and the nearest ones at the border.
fn mixed(image: &Image, u: f64, v: f64, channel: usize) -> f64 {
    let value = |column: f64, row: f64| {
        let column = column.clamp(0.0, (WIDTH - 1) as f64) as usize;
        let row = row.clamp(0.0, (HEIGHT - 1) as f64) as usize;
        f64::from(image.rgb8[3 * (row * WIDTH + column) + channel])
    };
    let [column, row] = [(u - 0.5).floor(), (v - 0.5).floor()];
    let [x, y] = [u - 0.5 - column, v - 0.5 - row];
    let above = (1.0 - x) * value(column, row) + x * value(column + 1.0, row);
    let below = (1.0 - x) * value(column, row + 1.0) + x * value(column + 1.0, row + 1.0);
    (1.0 - y) * above + y * below
}

#[test]
fn the_depth_of_the_pixel_decides_and_a_hole_never_fits() {
    for wall_m in [0.1, 8.0] {
        let depth_m = vec![wall_m; WIDTH * HEIGHT];
        let is_hole = |at: usize| (at % WIDTH + 2 * (at / WIDTH)).is_multiple_of(3);
        let holes: Vec<f32> =
            depth_m.iter().enumerate().map(|(at, m)| if is_hole(at) { 0.0 } else { *m }).collect();
        let warped = warped(&depth_m, Pose::IDENTITY, &[reference(noise(), holes, Pose::IDENTITY)]);
        for (at, valid) in warped.valid.iter().enumerate() {
            assert_eq!(*valid > 0.0, !is_hole(at), "pixel {at} at {wall_m} m");
        }
    }
    // Nor does a pixel of the view that has no depth.
    let mut depth_m = wall();
    depth_m[10 * WIDTH + 5] = 0.0;
    let warped = warped(&depth_m, Pose::IDENTITY, &[reference(noise(), wall(), Pose::IDENTITY)]);
    assert_eq!(warped.valid[10 * WIDTH + 5], 0.0);
    assert_eq!(warped.pixels, [WIDTH * HEIGHT - 1]);
}

/// One colour.
fn painted(rgb: [u8; 3], depth_m: f64, pose: Pose) -> Arc<Reference> {
    let image = Image { width: WIDTH, height: HEIGHT, rgb8: rgb.repeat(WIDTH * HEIGHT) };
    reference(image, vec![depth_m as f32; WIDTH * HEIGHT], pose)
}

#[test]
fn a_similar_direction_wins_over_a_shorter_way_and_counts_are_in_the_order_of_the_list() {
    let behind = painted([200, 0, 0], WALL_M + 4.0, moved(0.0, 0.0, -4.0));
    let beside = painted([0, 200, 0], WALL_M, moved(1.0, 0.0, 0.0));
    let middle = 23 * WIDTH + 41;
    for references in [[behind.clone(), beside.clone()], [beside, behind]] {
        let is_first = references[0].world_from_camera.position_m.z < 0.0;
        let warped = warped(&wall(), Pose::IDENTITY, &references);
        assert_eq!(warped.image.rgb8[3 * middle..][..3], [200, 0, 0]);
        let red = warped.image.rgb8.chunks_exact(3).filter(|rgb| rgb[0] == 200).count();
        let green = warped.image.rgb8.chunks_exact(3).filter(|rgb| rgb[1] == 200).count();
        assert!(red > 0 && green > 0, "{red} and {green}: at the border it is the other");
        let counts = if is_first { [red, green] } else { [green, red] };
        assert_eq!(warped.pixels, counts);
        assert_eq!(warped.valid.iter().filter(|valid| **valid > 0.0).count(), red + green);
    }
}

#[test]
fn each_reference_is_seen_through_its_own_camera() {
    // Half as large an image of the same field.
    let half = camera().scaled(42, 24).unwrap();
    let image = Image { width: 42, height: 24, rgb8: vec![90; 3 * 42 * 24] };
    let small = Arc::new(Reference {
        image,
        depth_m: vec![WALL_M as f32; 42 * 24],
        projection: Arc::new(Projection::from_camera(&half)),
        world_from_camera: Pose::IDENTITY,
    });
    let side = painted([0, 200, 0], WALL_M, moved(1.0, 0.0, 0.0));
    let warped = warped(&wall(), Pose::IDENTITY, &[side, small]);
    assert_eq!(warped.pixels, [0, WIDTH * HEIGHT]);
    assert!(warped.image.rgb8.iter().all(|value| *value == 90));
}
