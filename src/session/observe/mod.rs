//! Observations: which images are drawn, and how they become the bytes of one message.

pub(crate) mod buffer;
pub(crate) mod builder;
pub(crate) mod encode;
pub(crate) mod frame_history;
pub(crate) mod observation;
pub(crate) mod schedule;
pub(crate) mod trust;
