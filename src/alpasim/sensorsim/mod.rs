//! wildcity as AlpaSim's renderer: the service `nre.grpc.protos.sensorsim.SensorsimService`.
//!
//! ```text
//! listen    accepts connections, and calls a method by its path
//! methods   the ten methods
//! render    requests for images
//! objects   the assets of dynamic objects
//! open      twins with reserved memory
//! status    the gRPC status of each error
//! ```

mod listen;
mod methods;
mod objects;
mod open;
mod render;
mod status;

pub use listen::{AlpasimError, Running, start};
pub(crate) use render::OpenScene;
pub use render::offered_cameras;
pub(crate) use status::SensorsimError;
