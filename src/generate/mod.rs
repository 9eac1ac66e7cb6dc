//! Procedural twins.
