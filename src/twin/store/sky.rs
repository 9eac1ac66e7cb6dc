//! The sky of a version: an object of its own, which versions share.

use std::sync::Arc;

use glam::DMat3;

use crate::ingest::sky;
use crate::limits;
use wildcity_scene::manifest::SkyRef;
use wildcity_scene::{RenderProfile, Sky};

use super::objects::Staging;
use super::{Catalog, StoreError, Version};

/// The sky of a version in the making.
#[derive(Clone, Debug)]
pub enum NewSky {
    /// That of an earlier version of the twin.
    Kept(SkyRef),
    /// One of its own.
    Put(SkyBytes),
}

/// A sky as it is stored, and how it is looked at.
#[derive(Clone, Debug)]
pub struct SkyBytes {
    /// What [`sky::decode`] reads.
    pub bytes: Arc<[u8]>,
    /// Whose appearance it is seen with: an index, or the mean of all.
    pub image: Option<u32>,
    /// Takes directions in the world to the sky's own axes; orthonormal.
    pub sky_from_world: DMat3,
}

impl NewSky {
    /// Whether it can be drawn as the profile asks.
    ///
    /// # Errors
    /// It cannot be read, or not be baked as finely as the profile asks.
    pub(super) fn check(&self, profile: &RenderProfile) -> Result<(), StoreError> {
        match self {
            Self::Kept(_) => Ok(()),
            Self::Put(SkyBytes { bytes, image, sky_from_world }) => {
                let sky = Sky::new(sky::decode(bytes, *image)?, *sky_from_world);
                sky.drawable(profile.sky_error).map_err(crate::ingest::IngestError::Sky)?;
                Ok(())
            }
        }
    }

    /// Writes what is new, and names it.
    pub(super) fn put(&self, staging: &mut Staging) -> Result<SkyRef, StoreError> {
        match self {
            Self::Kept(sky) => Ok(sky.clone()),
            Self::Put(SkyBytes { bytes, image, sky_from_world }) => {
                let put = staging.put(|out| out.write_all(bytes))?;
                Ok(SkyRef {
                    object: put.hash,
                    bytes: put.bytes,
                    image: *image,
                    sky_from_world: sky_from_world.transpose().to_cols_array_2d(),
                })
            }
        }
    }
}

impl Catalog {
    /// Reads the sky of a version, if it has one, and checks it against its hash.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] if it is not what was committed.
    pub fn sky(&self, version: &Version) -> Result<Option<Sky>, StoreError> {
        let Some(named) = &version.manifest.sky else { return Ok(None) };
        let twin = &version.manifest.twin;
        let bytes = self.objects.read_object(twin, &named.object, limits::SKY_FILE_BYTES)?;
        let damaged = |reason: String| {
            let path = self.objects.path(twin, &named.object);
            StoreError::Damaged { path, reason }
        };
        let model = sky::decode(&bytes, named.image).map_err(|error| damaged(error.to_string()))?;
        let axes = DMat3::from_cols_array_2d(&named.sky_from_world).transpose();
        let skew = axes * axes.transpose() - DMat3::IDENTITY;
        let is_orthonormal = skew.to_cols_array().iter().all(|error| error.abs() <= 1e-9);
        if !is_orthonormal {
            return Err(damaged(format!("its axes {axes:?} are not orthonormal")));
        }
        Ok(Some(Sky::new(model, axes)))
    }
}
