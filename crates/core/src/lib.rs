//! The method of viewrank: ranks multi-view stereo view clusters before any depth map is computed.
//!
//! This crate reads and writes no file. A [`Scene`](model::scene::Scene) comes from arrays or from
//! the readers of `viewrank-io`; pictures come through the trait
//! [`Pictures`](method::confidence::Pictures).

#![deny(clippy::print_stdout, clippy::print_stderr)]

pub mod base;
pub mod decision;
pub mod method;
pub mod model;
