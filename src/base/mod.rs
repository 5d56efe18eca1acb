//! The ground floor of this crate: that of the crates below, signals and processes, how the command
//! line says advice, and what is printable.

pub mod advice;
pub mod platform;
pub mod printable;

pub use viewrank_core::base::*;
pub use viewrank_io::{bounded, input, packed, paths, shell};
