//! Observations: which images are rendered, and how they become the bytes of one message.
//!
//! An observation travels as a safetensors file. Its header comes before the pixels but holds their
//! hashes and the timings, so the buffer is laid out first, with padding for the header:
//!
//! ```text
//! | header | ego.history_xyz, ego.history_rot | depth, opacity, normals per image | instances | classes | colour per image |
//! | colour of earlier frames |
//! ```
//!
//! The renderer writes depth, opacity, normals and raw colour straight into the message. JPEG and
//! PNG files are appended, since their length is only known after encoding. Every image is encoded
//! and hashed in the renderer's [`OnViewDone`](wildcity_render::OnViewDone) callback, while other
//! cameras are still rendered. The frame hash is the hash of the images' hashes, so that it needs
//! no second pass over the pixels. `server` writes the header last. Floats come before bytes, so
//! that every float tensor starts at a multiple of 4.
//!
//! **Which frames are rendered** depends only on the simulated time ([`schedule`]): only those that
//! the observation of some decision contains. A frame that a later observation contains again is
//! kept in the [`frame_history`] in the form in which it is sent, as a file or as pixels, and
//! counts against the budget for answers. A frame that an observation contains and that is not in
//! the history is rendered with that observation. So a warm-up needs no special case: its poses are
//! in the episode's track at negative times, and at the first request none of its frames is in the
//! history.
//!
//! **An overlay is part of the rig**, as PNG in the rig's JSON. So messages, manifests and
//! recordings contain it without further code, and it is cropped and scaled with its camera. A
//! session's overlays count against the budget for answers.

pub(crate) mod buffer;
pub(crate) mod builder;
pub(crate) mod encode;
pub(crate) mod frame_history;
pub(crate) mod jpeg;
pub(crate) mod layout;
pub(crate) mod observation;
pub(crate) mod point_cloud;
pub(crate) mod schedule;
pub(crate) mod trust;
