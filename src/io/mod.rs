//! Files: readers of sparse models, meshes, images and depth maps, project folders, their caches,
//! and atomic writes of sets of files.

pub mod cache;
pub mod depthmaps;
pub mod formats;
pub mod output;
pub mod picture;
pub mod ply;
pub mod project;
pub mod region_file;
