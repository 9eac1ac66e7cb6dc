//! The sky of a version: an object of its own, which versions share.

use std::sync::Arc;

use glam::DMat3;

use crate::ingest::sky;
use crate::limits;
use wildcity_scene::manifest::SkyRef;
use wildcity_scene::{RenderProfile, Sky};

use super::backend::Staging;
use super::{Catalog, StoreError, Version};

/// The sky of a version in preparation.
#[derive(Clone, Debug)]
pub enum NewSky {
    /// The sky of an earlier version of the twin.
    Kept(SkyRef),
    Put(SkyBytes),
}

/// A sky as stored, with its appearance and orientation.
#[derive(Clone, Debug)]
pub struct SkyBytes {
    /// The bytes that [`sky::decode`] reads.
    pub bytes: Arc<[u8]>,
    /// Index of the training image with the appearance that it is drawn in; the mean of all if
    /// `None`.
    pub image: Option<u32>,
    /// Rotates directions in the world to the sky's own axes; orthonormal.
    pub sky_from_world: DMat3,
}

impl NewSky {
    /// Checks that it can be drawn with the profile's `sky_error`.
    ///
    /// # Errors
    /// It cannot be read, or cannot be baked finely enough.
    pub(super) fn check(&self, profile: &RenderProfile) -> Result<(), StoreError> {
        match self {
            Self::Kept(_) => Ok(()),
            Self::Put(SkyBytes { bytes, image, sky_from_world }) => {
                let sky = Sky::new(sky::decode(bytes, *image)?, *sky_from_world);
                // Baked once here, so that no version is committed whose sky can never be drawn.
                sky.drawable(profile.sky_error).map_err(crate::ingest::IngestError::Sky)?;
                Ok(())
            }
        }
    }

    /// Writes a new sky. Returns what the manifest names.
    pub(super) fn put(&self, staging: &mut dyn Staging) -> Result<SkyRef, StoreError> {
        match self {
            Self::Kept(sky) => Ok(sky.clone()),
            Self::Put(SkyBytes { bytes, image, sky_from_world }) => {
                let put = staging.put(Box::new(|out| out.write_all(bytes)))?;
                Ok(SkyRef {
                    object: put.hash,
                    bytes: put.bytes,
                    image: *image,
                    // The manifest has rows; `DMat3` has columns.
                    sky_from_world: sky_from_world.transpose().to_cols_array_2d(),
                })
            }
        }
    }
}

impl Catalog {
    /// Reads the sky of a version, if it has one, and compares it with its hash.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] if it differs from what was committed.
    pub fn sky(&self, version: &Version) -> Result<Option<Sky>, StoreError> {
        let Some(named) = &version.manifest.sky else { return Ok(None) };
        let twin = &version.manifest.twin;
        let bytes = self.objects.read_object(twin, &named.object, limits::SKY_FILE_BYTES)?;
        let damaged = |reason: String| {
            let path = self.objects.object_path(twin, &named.object);
            StoreError::Damaged { path, reason }
        };
        let model = sky::decode(&bytes, named.image).map_err(|error| damaged(error.to_string()))?;
        let axes = DMat3::from_cols_array_2d(&named.sky_from_world).transpose();
        // R Rᵀ = I, within far more than the rounding of f64 (1e-16).
        let skew = axes * axes.transpose() - DMat3::IDENTITY;
        let is_orthonormal = skew.to_cols_array().iter().all(|error| error.abs() <= 1e-9);
        if !is_orthonormal {
            return Err(damaged(format!("its axes {axes:?} are not orthonormal")));
        }
        Ok(Some(Sky::new(model, axes)))
    }
}
