//! Skies: a colour for every direction, infinitely far away.
//!
//! A pixel is `C = C_gaussians + T C_sky(direction)`, where T is the transmittance of its
//! Gaussians. A sky is a network, as street reconstructions train it, or a cube map of six images.
//!
//! Since a sky depends only on the direction, a network of 12,000 multiplications per pixel is
//! baked into a cube map of at most 50 MB when a twin is opened (`bake.rs`). The field `sky_error`
//! of the render profile bounds the error of the map in any direction; 0 evaluates the network for
//! every pixel, in f32. The reference backend always evaluates the network, in f64. A sky has at
//! most four maps, one per resolution, 67 MB together. Sessions share them, so none is baked twice.
//! A session whose `sky_error` is below the error of the finest map is refused when it opens.
//!
//! Images become the faces of a cube map at import and are not baked. Baked grids have values on
//! the very edges of the faces, which neighbouring faces share; images have a border of one value
//! that is looked up from the neighbouring faces. Both use one formula with different scales and
//! offsets, so no look-up needs to test where a face ends.

mod bake;
mod cube;
mod inference;
mod network;

use std::sync::Arc;

use glam::{DMat3, DVec3};

use self::bake::Maps;

pub use cube::{CubeMap, FACES};
pub use inference::{InferenceNetwork, Scratch};
pub use network::{Layer, Network};

/// The sky is not evaluated where the transmittance is below this value: it would change a pixel by
/// at most one step of 8 bits, and nine of ten pixels of a street are of this kind. Every backend
/// does the same, so it is part of the definition of an image.
pub const SKY_CUT: f64 = 1.0 / 255.0;

/// A sky, ready to be evaluated.
#[derive(Debug)]
pub struct Sky {
    model: SkyModel,
    /// Takes world axes to the axes of the model: orthonormal, possibly a reflection.
    sky_from_world: DMat3,
    /// The maps that have been baked.
    baked: Maps,
}

/// The model of a sky.
#[derive(Clone, Debug)]
pub enum SkyModel {
    /// The network by definition, and its form for fast evaluation.
    Network(Arc<Network>, Arc<InferenceNetwork>),
    Cube(Arc<CubeMap>),
}

/// A sky in the form in which a backend evaluates it.
#[derive(Clone, Debug)]
pub enum DrawableSky {
    /// The network, evaluated for every pixel.
    Network(Arc<InferenceNetwork>),
    CubeMap(Arc<CubeMap>),
}

impl DrawableSky {
    /// Whether both share the same data in memory.
    pub fn ptr_eq(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Network(own), Self::Network(other)) => Arc::ptr_eq(own, other),
            (Self::CubeMap(own), Self::CubeMap(other)) => Arc::ptr_eq(own, other),
            _ => false,
        }
    }

    /// Memory of the weights or texels, in bytes.
    pub fn bytes(&self) -> usize {
        match self {
            Self::Network(network) => network.bytes(),
            Self::CubeMap(map) => map.bytes(),
        }
    }
}

/// Why a sky was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SkyError {
    /// The shape of a tensor does not fit the others, or is too large.
    #[error("tensor {tensor} has shape {shape:?}; {must}")]
    Shape {
        /// Name of the tensor in the file.
        tensor: &'static str,
        /// Shape of the tensor.
        shape: Vec<usize>,
        /// The values that are accepted.
        must: String,
    },
    /// A weight is not finite or too large.
    #[error("tensor {tensor} holds {value:?} at {index}; weights are finite and within 1e6")]
    Value {
        /// Name of the tensor in the file.
        tensor: &'static str,
        /// Index of the value, row by row.
        index: usize,
        value: f32,
    },
    /// There is no appearance embedding of this index.
    #[error("the sky has the appearances of {count} images, from 0; there is no image {image}")]
    Image { image: u32, count: usize },
    /// The faces are empty or too large.
    #[error(
        "a face of the sky is {side_px} pixels wide; 1 to {} are accepted",
        CubeMap::MAX_SIDE_PX
    )]
    Side {
        /// Width of a face, in pixels.
        side_px: usize,
    },
    /// The number of bytes is not that of six faces.
    #[error("six faces of {side_px} x {side_px} pixels are {wanted} bytes of RGB, not {given}")]
    Pixels {
        /// Width of a face, in pixels.
        side_px: usize,
        /// Bytes of six such faces.
        wanted: usize,
        given: usize,
    },
    /// No cube map is fine enough for the requested error.
    #[error(
        "as a cube map with faces of {edge} x {edge} the sky has an error of up to {reached:.5}, and sky_error \
         is {wanted}: set sky_error to {reached:.5} or more, or to 0, which evaluates every pixel"
    )]
    Coarse {
        /// Values along an edge of the largest map.
        edge: usize,
        /// Error bound of that map.
        reached: f64,
        /// The requested error bound.
        wanted: f64,
    },
}

impl Sky {
    /// A sky with a model in its own axes; `sky_from_world` must be orthonormal.
    pub fn new(model: SkyModel, sky_from_world: DMat3) -> Self {
        Self { model, sky_from_world, baked: Maps::default() }
    }

    /// The colour in [0, 1] along a unit direction in world axes, evaluated in f64 without baking.
    pub fn rgb(&self, direction_world: DVec3) -> DVec3 {
        let direction = self.sky_from_world * direction_world;
        match &self.model {
            SkyModel::Network(network, _) => network.rgb(direction),
            SkyModel::Cube(map) => map.rgb(direction),
        }
    }

    /// The matrix that takes directions in world axes to the axes of [`Sky::drawable`].
    pub fn sky_from_world(&self) -> DMat3 {
        self.sky_from_world
    }

    /// The network or the cube map, in its own axes.
    pub fn model(&self) -> &SkyModel {
        &self.model
    }

    /// The form in which a backend evaluates the sky with a profile's `sky_error`. A network is
    /// baked on first use, which takes about a second, or ten seconds for the finest of the four
    /// maps; maps are kept. Images are returned as their own cube map for any error.
    ///
    /// # Errors
    /// [`SkyError::Coarse`] if no map up to [`CubeMap::MAX_EDGE`] has a small enough error.
    pub fn drawable(&self, sky_error: f64) -> Result<DrawableSky, SkyError> {
        match &self.model {
            // A cube map of images is exact by definition.
            SkyModel::Cube(map) => Ok(DrawableSky::CubeMap(map.clone())),
            SkyModel::Network(_, folded) if sky_error == 0.0 => {
                Ok(DrawableSky::Network(folded.clone()))
            }
            SkyModel::Network(_, folded) => {
                self.baked.get(folded, sky_error).map(DrawableSky::CubeMap)
            }
        }
    }

    /// Memory of the model and of its baked maps, in bytes.
    pub fn bytes(&self) -> usize {
        self.baked.bytes()
            + match &self.model {
                // Its fast form has about as many weights.
                SkyModel::Network(network, _) => 2 * network.bytes(),
                SkyModel::Cube(map) => map.bytes(),
            }
    }
}

impl SkyModel {
    /// A model from a network.
    pub fn network(network: Network) -> Self {
        let folded = Arc::new(InferenceNetwork::new(&network));
        Self::Network(Arc::new(network), folded)
    }

    /// A model from six images.
    pub fn cube(map: CubeMap) -> Self {
        Self::Cube(Arc::new(map))
    }
}
