//! Small scenes with the images that their authors expect: what is read is drawn so, or refused or
//! warned of by name.

use std::path::Path;

use half::f16;

use wildcity_render::reference::Reference;
use wildcity_render::{Backend, Frame, Target, View};
use wildcity_scene::{Gaussians, RenderProfile, Scene};
use wildcity_twin::ingest::{self, IngestError, ReadLimits, ReadScene};

use crate::data::real;

/// Reads a file of a case.
fn read(file: &str, drop_bad: bool) -> Option<Result<ReadScene, IngestError>> {
    let path = real(&format!("cases/{file}"))?;
    let limits = ReadLimits { drop_bad, ..ReadLimits::for_own_file() };
    Some(ingest::read_limited(&path, &limits, &mut |_, _| {}))
}

/// A file of a case that is accepted.
fn accepted(file: &str) -> Option<ReadScene> {
    Some(read(file, false)?.unwrap_or_else(|error| panic!("{file}: {error}")))
}

/// The message for a file of a case that is refused, as the command line prints it, with every
/// source.
fn refusal(file: &str) -> Option<String> {
    let error = read(file, false)?.unwrap_err();
    let sources = std::iter::successors(std::error::Error::source(&error), |e| e.source());
    Some(sources.fold(error.to_string(), |text, source| format!("{text}: {source}")))
}

/// The values of a float16 image: red, green, blue.
fn f16_image(path: &Path) -> Vec<f32> {
    let file = std::fs::read(path).unwrap();
    let start = 10 + usize::from(u16::from_le_bytes([file[8], file[9]]));
    assert!(std::str::from_utf8(&file[10..start]).unwrap().contains("'<f2'"));
    file[start..].as_chunks().0.iter().map(|&bytes| f16::from_le_bytes(bytes).to_f32()).collect()
}

/// The image of a scene as `wildcity render --backend reference` makes it.
fn drawn(scene: &ReadScene, camera: &Path) -> Vec<f32> {
    let listed = ingest::cameras::read(camera).unwrap().remove(0);
    let profile = scene.notes.profile().apply(RenderProfile::DEFAULT).unwrap();
    let view = View::new(listed.camera, listed.world_from_camera);
    let mut rgba = vec![0.0; 4 * view.camera.pixels()];
    let target = Target { rgba: Some(&mut rgba), ..Target::default() };
    let scene = Scene::from_gaussians(&scene.gaussians);
    let frame = Frame { scene: &scene, profile: &profile, views: &[view] };
    Reference.render(&frame, &mut [target], &|_, _| {}).unwrap();
    rgba.chunks_exact(4).flat_map(|pixel| pixel[..3].to_vec()).collect()
}

/// Checks that a file is drawn as the truth, to the steps of float16.
fn check_image(case: &str, file: &str, truth: &str) -> Option<()> {
    let scene = accepted(&format!("{case}/{file}"))?;
    let truth = f16_image(&real(&format!("cases/{case}/{truth}"))?);
    let image = drawn(&scene, &real(&format!("cases/{case}/cam.json"))?);
    assert_eq!(image.len(), truth.len());
    let off = image.iter().zip(&truth).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(off < 1e-3, "{case}/{file} is off by {off}");
    Some(())
}

#[test]
fn infinite_logits_are_opacities_of_0_and_1() {
    check_image("opacity_infinite", "opacity_inf.ply", "plus.npy");
    check_image("opacity_infinite", "opacity_minf.ply", "minus.npy");
}

#[test]
fn flat_gaussians_have_the_smallest_thickness() {
    for file in ["twodgs.ply", "scale_1e-20.ply", "scale_minf.ply"] {
        check_image("flat_gaussians", file, "flat.npy");
    }
    let Some(flat) = accepted("flat_gaussians/twodgs.ply") else { return };
    assert!(flat.notes.warnings[0].contains("no property scale_2"), "{:?}", flat.notes);
}

#[test]
fn dialects_of_ply_are_the_same_gaussians() {
    let Some(base) = accepted("ply_dialects/base.ply") else { return };
    for file in ["ascii.ply", "be.ply", "meshlab_face0.ply"] {
        let other = accepted(&format!("ply_dialects/{file}")).unwrap();
        assert_eq!(other.gaussians, base.gaussians, "{file}");
        assert_eq!(other.notes.warnings, Vec::<String>::new(), "{file}");
    }
    let rgb = accepted("ply_dialects/ns_rgb.ply").unwrap().gaussians;
    let half_step = 0.5 / 255.0 / 0.282_094_79 + 1e-6;
    let off = rgb.sh.iter().zip(&base.gaussians.sh).map(|(a, b)| (a - b).abs());
    assert!(off.fold(0.0, f32::max) <= half_step as f32);
    assert_eq!(Gaussians { sh: Vec::new(), ..rgb }, Gaussians { sh: Vec::new(), ..base.gaussians });
}

#[test]
fn rows_outside_their_bounds_are_refused_or_left_out() {
    for (file, field) in [("nan1.ply", "is NaN"), ("zeroquat.ply", "length of rot is 0.0")] {
        let file = format!("bad_rows/{file}");
        let Some(text) = refusal(&file) else { return };
        assert!(text.contains(field) && text.matches("Gaussian").count() == 1, "{text}");
        let kept = read(&file, true).unwrap().unwrap();
        assert_eq!((kept.gaussians.len(), kept.notes.dropped), (59, 1), "{file}");
    }
}

#[test]
fn tags_of_antialiased_training_are_rendered() {
    check_image("antialiased_tag", "brush_mip.ply", "brush.npy");
    check_image("antialiased_tag", "postshot_aa.ply", "aa.npy");
    let Some(spz) = accepted("antialiased_tag/v3_aa.spz") else { return };
    let profile = spz.notes.profile().apply(RenderProfile::DEFAULT).unwrap();
    assert!(profile.antialiased && profile.blur == 0.3, "{profile:?}");
}

#[test]
fn the_3d_filter_of_mip_splatting_is_fused() {
    check_image("mip_filter_3d", "mip_filter3d.ply", "fused.npy");
}

#[test]
fn kernels_of_nurec_that_are_no_gaussians_are_refused_by_name() {
    if accepted("nurec_kernel/nurec2.usdz").is_none() {
        return;
    }
    for (file, named) in [
        ("nurec4.usdz", "config.layers.gaussians.particle.density_kernel_degree: is 4"),
        ("nurec_planar.usdz", "config.layers.gaussians.particle.density_kernel_planar: is true"),
    ] {
        let text = refusal(&format!("nurec_kernel/{file}")).unwrap();
        assert!(text.contains(named), "{text}");
    }
}

#[test]
fn linear_colours_of_gltf_are_warned_of_by_name() {
    let Some(srgb) = accepted("gltf_linear_colour/srgb.glb") else { return };
    assert_eq!(srgb.notes.warnings, Vec::<String>::new());
    let linear = accepted("gltf_linear_colour/lin.glb").unwrap().notes;
    assert!(linear.warnings[0].contains("colorSpace is \"lin_rec709_display\""), "{linear:?}");
}

#[test]
fn a_gltf_of_compressed_splats_is_read() {
    let Some(glb) = accepted("gltf_spz_compressed/spz2.glb") else { return };
    let base = accepted("ply_dialects/base.ply").unwrap();
    assert_eq!(glb.gaussians.len(), 60);
    for (a, b) in glb.gaussians.means_m.iter().zip(&base.gaussians.means_m) {
        assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-3), "{a:?} {b:?}");
    }
}

#[test]
fn the_coordinate_system_of_spz_is_known() {
    let Some(spz) = accepted("spz_coordinate_system/v4_rdf_ext.spz") else { return };
    let axes = spz.notes.axes.unwrap();
    assert_eq!(axes.axes.option_text(), "y-down-z-forward");
    assert!(axes.said_by.contains("6 (RDF)"), "{axes:?}");
}

#[test]
fn the_background_of_street_gaussians_is_read() {
    let Some(street) = accepted("street_gaussians/street_gaussians.ply") else { return };
    assert_eq!(street.gaussians.len(), 60);
    assert_eq!(street.notes.warnings, ["element vertex_obj_001 (10 rows) is not read"]);
}
