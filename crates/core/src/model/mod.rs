//! The sparse model: cameras, views, points and tracks, and its georeference; surface and clusters,
//! which the sections of the method hand on.

pub mod arrays;
pub mod camera;
pub mod cluster;
pub mod georeference;
pub mod mesh;
pub mod reason;
pub mod scene;
pub mod surface;
