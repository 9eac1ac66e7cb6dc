//! The ego's dynamics, against solvers of its equations; contacts and traffic, against vectors.

#[path = "../support/data.rs"]
mod data;
#[path = "../support/root.rs"]
mod root;
#[path = "../support/vectors.rs"]
mod vectors;

mod contact;
mod driving;
mod integrators;
mod solids;
mod study;
mod surface;
mod traffic;
