//! The method: one module per section of `docs/method.md`. Each depends only on those before it.

pub mod confidence;
pub mod fulfilment;
pub mod geometry;
pub mod partners;
pub mod pilot;
pub mod ranking;
pub mod region;
pub mod surface;
pub mod synthetic;
pub mod target;
pub mod twins;
pub mod visibility;
