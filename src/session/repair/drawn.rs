//! References in memory: recorded images with the twin's depth, and their pixels warped into a
//! view.

use std::sync::{Arc, OnceLock};

use image::{DynamicImage, ImageReader, Limits};

use wildcity_render::{Backend, Frame, RenderError, Target, View};
use wildcity_repair::Image;
use wildcity_repair::reference::{
    LEAST_OPACITY, Projection, Rays, Reference, WarpTarget, opaque_depth, overlaps, resized, warp,
};
use wildcity_scene::geometry::Camera;
use wildcity_scene::manifest::ObjectRef;
use wildcity_scene::rig::RigCamera;
use wildcity_scene::srgb::change_stops;
use wildcity_scene::views::reduced_mask;
use wildcity_scene::{RenderProfile, Scene};
use wildcity_twin::store::{Catalog, StoreError, Version};

use super::references::ReferenceView;
use super::rendered_image::RenderedImage;

/// Largest number of reference names that an observation reports per image.
pub(crate) const MAX_REPORTED_REFERENCES: usize = 8;

/// The rays of some cameras, each computed when it is first needed.
#[derive(Debug, Default)]
pub(crate) struct CameraRays(Vec<OnceLock<Rays>>);

/// References that the model gets in addition to an image.
#[derive(Debug, Default)]
pub(crate) struct ReferenceInputs {
    /// For the roles `reference_warped` and `reference_valid`.
    pub(crate) warped: Option<(Image, Vec<f32>)>,
    /// For the role `reference`, in the size of the image.
    pub(crate) reference: Option<Image>,
    pub(crate) nearest: Option<String>,
    /// The names of the references that contributed pixels, ordered from most to fewest pixels.
    pub(crate) names: Vec<String>,
}

/// A rendered image that may be repaired, for which references are searched and warped.
pub(crate) struct WarpQuery<'a> {
    pub(crate) camera: &'a RigCamera,
    pub(crate) rays: &'a Rays,
    pub(crate) view: &'a View,
    pub(crate) image: &'a RenderedImage,
}

impl ReferenceInputs {
    /// Adds the image of the role `reference`, in the size of a camera's images.
    pub(crate) fn set_reference(&mut self, name: &str, reference: &Reference, camera: &Camera) {
        let [width, height] = [camera.width_px, camera.height_px].map(|side| side as usize);
        // The model takes all images in one size.
        self.reference = Some(resized(&reference.image, width, height));
        self.nearest = Some(name.to_owned());
        self.names.push(name.to_owned());
    }
}

impl CameraRays {
    pub(crate) fn new(cameras: usize) -> Self {
        Self((0..cameras).map(|_| OnceLock::new()).collect())
    }

    /// The rays of a camera, by its index.
    pub(crate) fn camera_rays(&self, index: usize, camera: &RigCamera) -> &Rays {
        self.0[index].get_or_init(|| Rays::from_camera(&camera.camera))
    }
}

impl WarpQuery<'_> {
    /// Depth of the image where it is opaque.
    pub(crate) fn depth_m(&self) -> Vec<f32> {
        opaque_depth(&self.image.depth_m, &self.image.opacity)
    }

    fn target<'a>(&'a self, depth_m: &'a [f32]) -> WarpTarget<'a> {
        let shutter = self.view.rolling_shutter.as_ref();
        WarpTarget {
            camera: &self.camera.camera,
            rays: self.rays,
            world_from_camera: self.view.world_from_camera,
            shutter: shutter.map(|shutter| (shutter.direction, shutter.world_from_camera_first)),
            depth_m,
        }
    }

    /// Returns the references that overlap with the image, in about its resolution.
    pub(crate) fn overlapping(&self, references: Vec<ReferenceView>) -> Vec<ReferenceView> {
        let depth_m = self.depth_m();
        let target = self.target(&depth_m);
        let is_seen =
            |view: &ReferenceView| overlaps(&target, &view.camera, &view.world_from_camera);
        let seen = references.into_iter().filter(is_seen);
        // In the exposure of the view, and not much larger than it.
        seen.map(|view| view.exposed_for(self.camera).reduced_for(&self.camera.camera)).collect()
    }

    /// Warps references into the image, and adds the result and the names of the references to
    /// `inputs`.
    pub(crate) fn warped(
        &self,
        references: &[(String, Arc<Reference>)],
        inputs: &mut ReferenceInputs,
    ) {
        let depth_m = self.depth_m();
        let images: Vec<Arc<Reference>> =
            references.iter().map(|(_, reference)| reference.clone()).collect();
        let warped = warp(&self.target(&depth_m), &images);
        let mut used: Vec<(usize, &String)> =
            warped.pixels.iter().copied().zip(references.iter().map(|(name, _)| name)).collect();
        // A reference without a pixel in the result had no influence.
        used.retain(|(pixels, _)| *pixels > 0);
        used.sort_by(|(a, _), (b, _)| b.cmp(a));
        // The name for the role `reference` may be there already.
        let left = MAX_REPORTED_REFERENCES.saturating_sub(inputs.names.len());
        inputs.names.extend(used.into_iter().take(left).map(|(_, name)| name.clone()));
        inputs.warped = Some((warped.image, warped.valid));
    }
}

/// A recorded image that was read.
pub(crate) struct ReadImage {
    image: Image,
    /// Mask of the pixels that count; `None` if all count.
    counts: Option<Vec<bool>>,
}

/// Reads the recorded image of a reference, in the reference's size and exposure, and its mask.
/// `None` if the reference has no recorded image. Blocks.
///
/// # Errors
/// The image or the mask cannot be read, or is not one of its camera's size.
pub(crate) fn read(
    catalog: &Catalog,
    version: &Version,
    view: &ReferenceView,
) -> Result<Option<ReadImage>, StoreError> {
    let Some(recorded) = &view.recorded else { return Ok(None) };
    let bytes = catalog.view_image(version, recorded)?;
    let rgb8 = decoded(&bytes, &recorded.camera, &view.name, &recorded.image)?.into_rgb8();
    let recorded_px = [recorded.camera.width_px, recorded.camera.height_px];
    let [width, height] = recorded_px.map(|side| side as usize);
    let image = Image { width, height, rgb8: rgb8.into_raw() };
    let size_px = [view.camera.width_px, view.camera.height_px];
    let mut image = resized(&image, size_px[0] as usize, size_px[1] as usize);
    // First back to the light that it was taken in, and then to the exposure of the view.
    if let Some(stops) = recorded.exposure_stops {
        change_stops(&mut image.rgb8, -stops);
        if let Some(exposure) = &view.appearance.exposure {
            exposure.change_rgb8(&mut image.rgb8);
        }
    }
    // A pixel of the mask counts or does not: grey is rounded to the nearer of both.
    let mask = catalog.view_mask(version, recorded)?.zip(recorded.mask.as_ref());
    let counts = match mask {
        None => None,
        Some((bytes, object)) => {
            let luma = decoded(&bytes, &recorded.camera, &view.name, object)?.into_luma8();
            let counts: Vec<bool> = luma.as_raw().iter().map(|luma| *luma >= 128).collect();
            Some(reduced_mask(&counts, recorded_px, size_px))
        }
    };
    Ok(Some(ReadImage { image, counts }))
}

/// Decodes the image or the mask of a recorded view.
fn decoded(
    bytes: &[u8],
    camera: &Camera,
    name: &str,
    object: &ObjectRef,
) -> Result<DynamicImage, StoreError> {
    let damaged = |reason: String| StoreError::Damaged {
        path: format!("recorded image {name} ({})", object.object).into(),
        reason,
    };
    let width = camera.width_px;
    let height = camera.height_px;
    let mut reader = ImageReader::new(std::io::Cursor::new(bytes));
    // Before decoding: the header of a damaged file may claim any size.
    let mut limits = Limits::default();
    limits.max_image_width = Some(width);
    limits.max_image_height = Some(height);
    reader.limits(limits);
    let reader = reader.with_guessed_format().map_err(|error| damaged(error.to_string()))?;
    let image = reader.decode().map_err(|error| damaged(error.to_string()))?;
    // The limits refuse larger images only.
    if [image.width(), image.height()] != [width, height] {
        let w = image.width();
        let h = image.height();
        return Err(damaged(format!("it has {w} x {h} px; its camera has {width} x {height}")));
    }
    Ok(image)
}

/// Renders the depth of a reference, and its pixels if it has no recorded ones.
pub(crate) fn draw(
    view: &ReferenceView,
    recorded: Option<ReadImage>,
    projection: Arc<Projection>,
    scene: &Scene,
    profile: &RenderProfile,
    backend: &dyn Backend,
) -> Result<Reference, RenderError> {
    let pixels = view.camera.pixels();
    let views = [view.view()];
    let mut depth_m = vec![0.0; pixels];
    let mut opacity = vec![0.0; pixels];
    // Pixels are drawn only if none were recorded. Depth always comes from the twin.
    let is_drawn = recorded.is_none();
    let blank = || Image {
        width: view.camera.width_px as usize,
        height: view.camera.height_px as usize,
        rgb8: vec![0; 3 * pixels],
    };
    let (image, counts) = recorded.map(|read| (read.image, read.counts)).unzip();
    let mut image = image.unwrap_or_else(blank);
    let target = Target {
        rgb8: is_drawn.then_some(&mut image.rgb8[..]),
        depth_m: Some(&mut depth_m),
        opacity: Some(&mut opacity),
        appearance: is_drawn.then_some(&view.appearance),
        ..Target::default()
    };
    backend.render(&Frame { scene, profile, views: &views }, &mut [target], &|_, _| {})?;
    // Where the twin lets light through, its depth is that of no surface.
    for (depth_m, opacity) in depth_m.iter_mut().zip(&opacity) {
        if *opacity < LEAST_OPACITY {
            *depth_m = 0.0;
        }
    }
    // Pixels that the mask excludes have no depth, so that they match no point.
    for (depth_m, _) in
        depth_m.iter_mut().zip(counts.flatten().iter().flatten()).filter(|(_, counts)| !**counts)
    {
        *depth_m = 0.0;
    }
    let world_from_camera = view.world_from_camera;
    Ok(Reference { image, depth_m, projection, world_from_camera })
}
