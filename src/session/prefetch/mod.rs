//! Prefetching: where the ego may be soon, so that what it will see there is loaded before it is
//! requested. A wrong forecast costs time, and never changes an image.

pub(crate) mod forecast;
pub(crate) mod latest_task;
pub(crate) mod recorded_drive;
