//! Files: sparse models, meshes and depth maps to read, project folders, and whole-or-nothing sets of files to write.

pub mod depthmaps;
pub mod formats;
pub mod output;
pub mod ply;
pub mod project;
