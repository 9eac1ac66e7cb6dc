//! What lies behind everything: a colour for every direction, infinitely far away.
//!
//! A pixel is `C = C_gaussians + T C_sky(direction)`, where T is the share of the background that its
//! Gaussians let through. A sky is a network, as street reconstructions train it, or six images. As it
//! depends on the direction alone, a network is baked into a cube map when a twin opens, as finely as
//! the profile's `sky_error` asks; 0 evaluates it for every pixel.

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

/// Where the background shows by less than this, the sky is left away: it would add at most one step of
/// 8 bits, and nine pixels in ten of a street are such. It is part of what an image is, in every backend.
pub const SKY_CUT: f64 = 1.0 / 255.0;

/// A sky, ready to be looked at.
#[derive(Debug)]
pub struct Sky {
    model: SkyModel,
    /// Takes world axes to the model's: a rotation, perhaps with a mirror.
    sky_from_world: DMat3,
    /// What was baked so far.
    baked: Maps,
}

/// What a sky is made of.
#[derive(Clone, Debug)]
pub enum SkyModel {
    /// Weights, and the same for fast evaluation.
    Network(Arc<Network>, Arc<InferenceNetwork>),
    /// Six images.
    Cube(Arc<CubeMap>),
}

/// A sky in the form in which a backend draws it.
#[derive(Clone, Debug)]
pub enum DrawableSky {
    /// The network, pixel by pixel.
    Network(Arc<InferenceNetwork>),
    /// A cube map.
    CubeMap(Arc<CubeMap>),
}

impl DrawableSky {
    /// Whether it is the very same.
    pub fn ptr_eq(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Network(own), Self::Network(other)) => Arc::ptr_eq(own, other),
            (Self::CubeMap(own), Self::CubeMap(other)) => Arc::ptr_eq(own, other),
            _ => false,
        }
    }

    /// Memory of what is looked up or multiplied, in bytes.
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
    /// A tensor does not fit the others, or is of absurd size.
    #[error("tensor {tensor} has shape {shape:?}; {must}")]
    Shape {
        /// Its name in the file.
        tensor: &'static str,
        /// Its shape.
        shape: Vec<usize>,
        /// What must hold instead.
        must: String,
    },
    /// A weight that no arithmetic survives.
    #[error("tensor {tensor} holds {value:?} at {index}; weights are finite and within 1e6")]
    Value {
        /// Its name in the file.
        tensor: &'static str,
        /// Index of the value, row by row.
        index: usize,
        /// The value.
        value: f32,
    },
    /// No such appearance.
    #[error("the sky has the appearances of {count} images, from 0; there is no image {image}")]
    Image {
        /// The image asked for.
        image: u32,
        /// How many there are.
        count: usize,
    },
    /// Faces that are empty or too large.
    #[error(
        "a face of the sky is {side_px} pixels wide; 1 to {} are accepted",
        CubeMap::MAX_SIDE_PX
    )]
    Side {
        /// Width of a face, in pixels.
        side_px: usize,
    },
    /// Not as many pixels as six faces have.
    #[error("six faces of {side_px} x {side_px} pixels are {wanted} bytes of RGB, not {given}")]
    Pixels {
        /// Width of a face, in pixels.
        side_px: usize,
        /// Bytes that they have.
        wanted: usize,
        /// Bytes given.
        given: usize,
    },
    /// The sky is too sharp for the error that is asked for.
    #[error(
        "as a cube map with faces of {edge} x {edge} the sky is off by up to {reached:.5}, and sky_error \
         is {wanted}: set sky_error to {reached:.5} or more, or to 0, which evaluates every pixel"
    )]
    Coarse {
        /// Values along an edge of the largest map.
        edge: usize,
        /// The bound of its error.
        reached: f64,
        /// The bound that is asked for.
        wanted: f64,
    },
}

impl Sky {
    /// A sky whose model has axes of its own: `sky_from_world` is orthonormal.
    pub fn new(model: SkyModel, sky_from_world: DMat3) -> Self {
        Self { model, sky_from_world, baked: Maps::default() }
    }

    /// The colour towards a unit direction in world axes, in [0, 1]: by definition, in f64.
    pub fn rgb(&self, direction_world: DVec3) -> DVec3 {
        let direction = self.sky_from_world * direction_world;
        match &self.model {
            SkyModel::Network(network, _) => network.rgb(direction),
            SkyModel::Cube(map) => map.rgb(direction),
        }
    }

    /// Takes directions in world axes to the axes of what [`Sky::drawable`] gives.
    pub fn sky_from_world(&self) -> DMat3 {
        self.sky_from_world
    }

    /// What it is made of.
    pub fn model(&self) -> &SkyModel {
        &self.model
    }

    /// The form in which it is drawn with a profile's `sky_error`. Bakes a network the first time, which
    /// takes about a second, and ten for the finest of its four maps; they stay. Images are their own cube
    /// map, whatever the error.
    ///
    /// # Errors
    /// [`SkyError::Coarse`] if no map up to [`CubeMap::MAX_EDGE`] is close enough.
    pub fn drawable(&self, sky_error: f64) -> Result<DrawableSky, SkyError> {
        match &self.model {
            SkyModel::Cube(map) => Ok(DrawableSky::CubeMap(map.clone())),
            SkyModel::Network(_, folded) if sky_error == 0.0 => {
                Ok(DrawableSky::Network(folded.clone()))
            }
            SkyModel::Network(_, folded) => {
                self.baked.get(folded, sky_error).map(DrawableSky::CubeMap)
            }
        }
    }

    /// Memory that it takes, in bytes.
    pub fn bytes(&self) -> usize {
        self.baked.bytes()
            + match &self.model {
                SkyModel::Network(network, _) => 2 * network.bytes(),
                SkyModel::Cube(map) => map.bytes(),
            }
    }
}

impl SkyModel {
    /// A network.
    pub fn network(network: Network) -> Self {
        let folded = Arc::new(InferenceNetwork::new(&network));
        Self::Network(Arc::new(network), folded)
    }

    /// Six images.
    pub fn cube(map: CubeMap) -> Self {
        Self::Cube(Arc::new(map))
    }
}
