//! The ground floor of this crate: that of the crates below, signals and processes.

pub mod platform;

pub use viewrank_core::base::*;
pub use viewrank_io::{input, packed, paths, shell};
