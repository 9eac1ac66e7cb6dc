//! The ego's dynamics, against solvers of its equations.

mod driving;
mod integrators;
mod study;
