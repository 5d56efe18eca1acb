//! Files for viewrank: readers of sparse models, meshes, images and depth maps, project folders,
//! their caches, and atomic writes of sets of files.

#![deny(clippy::print_stdout, clippy::print_stderr)]

pub mod bounded;
pub mod cache;
pub mod depthmaps;
pub mod formats;
pub mod image;
pub mod input;
pub mod jpeg;
pub mod json;
pub mod mistaken;
pub mod npy;
pub mod output;
pub mod packed;
pub mod paths;
pub mod picture;
pub mod pictures;
pub mod platform;
pub mod ply;
pub mod printable;
pub mod project;
pub mod region_file;
pub mod shell;
