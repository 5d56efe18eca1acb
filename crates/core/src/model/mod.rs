//! The sparse model: cameras, views, points and tracks, and its georeference.

pub mod arrays;
pub mod camera;
pub mod cluster;
pub mod georeference;
pub mod mesh;
pub mod reason;
pub mod scene;
