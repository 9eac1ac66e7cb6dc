//! The recorded images of a version: a table, and an object for each image. Versions share both.

use std::collections::BTreeSet;

use wildcity_scene::Manifest;
use wildcity_scene::align::Alignment;
use wildcity_scene::manifest::{ObjectRef, ViewsRef};
use wildcity_scene::views::RecordedView;

use super::layout::is_hash;
use super::{Catalog, Commit, StoreError, Version};
use crate::limits;

impl Commit {
    /// Writes an image or a mask, a JPEG or PNG, which [`Commit::put_views`] then names.
    ///
    /// # Errors
    /// [`StoreError::ViewSize`], or it cannot be written.
    pub fn put_image(&mut self, bytes: &[u8]) -> Result<ObjectRef, StoreError> {
        check_size("image", bytes.len() as u64, limits::VIEW_IMAGE_BYTES)?;
        self.put_object(bytes)
    }

    /// Writes the table of a version's recorded images. The version has them once a change or
    /// settings name the result.
    ///
    /// # Errors
    /// [`StoreError::ViewSize`], or it cannot be written.
    pub fn put_views(&mut self, views: &[RecordedView]) -> Result<ViewsRef, StoreError> {
        let table = self.catalog().encode(&views)?;
        // Checked before it is written, because no reader would accept it.
        check_size("table", table.len() as u64, limits::VIEWS_TABLE_BYTES)?;
        let ObjectRef { object, bytes } = self.put_object(&table)?;
        Ok(ViewsRef {
            object,
            bytes,
            images: views.len() as u64,
            // Masks count, too.
            image_bytes: views.iter().flat_map(objects).map(|object| object.bytes).sum(),
        })
    }
}

impl Catalog {
    /// The recorded images of a version, in the order of their table; none if it has none. Images
    /// are not read.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] if the table differs from what was committed.
    pub fn views(&self, version: &Version) -> Result<Vec<RecordedView>, StoreError> {
        self.read_views(&version.manifest)
    }

    /// Reads a recorded image, and compares it with its hash. Through the disk cache, if there is
    /// one.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] if it differs from what was committed.
    pub fn view_image(
        &self,
        version: &Version,
        view: &RecordedView,
    ) -> Result<Vec<u8>, StoreError> {
        let twin = &version.manifest.twin;
        self.objects.read_object(twin, &view.image.object, limits::VIEW_IMAGE_BYTES)
    }

    /// Reads the mask of a recorded image, as [`Catalog::view_image`]; `None` if all of its pixels
    /// count.
    ///
    /// # Errors
    /// As [`Catalog::view_image`].
    pub fn view_mask(
        &self,
        version: &Version,
        view: &RecordedView,
    ) -> Result<Option<Vec<u8>>, StoreError> {
        let Some(mask) = &view.mask else { return Ok(None) };
        let twin = &version.manifest.twin;
        self.objects.read_object(twin, &mask.object, limits::VIEW_IMAGE_BYTES).map(Some)
    }

    pub(super) fn read_views(&self, manifest: &Manifest) -> Result<Vec<RecordedView>, StoreError> {
        let Some(named) = &manifest.views else { return Ok(Vec::new()) };
        let twin = &manifest.twin;
        let bytes = self.objects.read_object(twin, &named.object, limits::VIEWS_TABLE_BYTES)?;
        let damaged = |reason: String| StoreError::Damaged {
            path: self.objects.object_path(twin, &named.object),
            reason,
        };
        let views: Vec<RecordedView> =
            serde_json::from_slice(&bytes).map_err(|error| damaged(error.to_string()))?;
        // The hashes become paths.
        let wrong = views.iter().flat_map(objects).find(|object| !is_hash(&object.object));
        match wrong.map(|object| object.object.clone()) {
            Some(object) => Err(damaged(format!("{object:?} is not a hash"))),
            None => Ok(views),
        }
    }

    /// The objects of a manifest's recorded images: the table, and each image and mask.
    pub(super) fn view_objects(&self, manifest: &Manifest) -> Result<BTreeSet<String>, StoreError> {
        let views = self.read_views(manifest)?;
        let images = views.iter().flat_map(objects).map(|object| object.object.clone());
        let table = manifest.views.iter().map(|views| views.object.clone());
        // A set, because views may share an object, such as a mask.
        Ok(images.chain(table).collect())
    }
}

/// The image of a view, and its mask.
pub(super) fn objects(view: &RecordedView) -> impl Iterator<Item = &ObjectRef> {
    [Some(&view.image), view.mask.as_ref()].into_iter().flatten()
}

/// The views after the world was turned, moved and scaled.
pub(super) fn aligned(views: &[RecordedView], alignment: &Alignment) -> Vec<RecordedView> {
    // The stored image stays; only the place from which it was taken is in other axes.
    let aligned = |view: &RecordedView| RecordedView {
        world_from_camera: alignment.pose(&view.world_from_camera),
        // A station is a length along a drive: only the scale changes it.
        station_m: alignment.metres_per_unit * view.station_m,
        ..view.clone()
    };
    views.iter().map(aligned).collect()
}

fn check_size(what: &'static str, bytes: u64, limit: u64) -> Result<(), StoreError> {
    if bytes > limit { Err(StoreError::ViewSize { what, bytes, limit }) } else { Ok(()) }
}
