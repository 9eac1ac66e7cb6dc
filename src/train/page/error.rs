//! Why there is no page.

use std::error::Error;

/// Why there is no page.
#[derive(Debug, thiserror::Error)]
pub enum PageError {
    /// A plot cannot be drawn.
    #[error("a plot of the page: {0}")]
    Plot(Box<dyn Error + Send + Sync>),
    /// A picture has not as many values as pixels.
    #[error("a picture of the page is not of {0} x {1} px")]
    Size(u32, u32),
    /// A picture cannot be encoded.
    #[error(transparent)]
    Picture(#[from] image::ImageError),
    /// The settings cannot be written.
    #[error(transparent)]
    Settings(#[from] toml::ser::Error),
}
