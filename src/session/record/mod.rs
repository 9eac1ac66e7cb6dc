//! Records of episodes, and their replay.

pub(crate) mod ego_replay;
pub(crate) mod format;
pub(crate) mod replay;
