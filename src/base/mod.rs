//! The ground floor of this crate: that of the crates below, signals and processes, and how the
//! command line says advice.

pub mod advice;
pub mod platform;

pub use viewrank_core::base::*;
pub use viewrank_io::{bounded, input, packed, paths, printable, shell};
