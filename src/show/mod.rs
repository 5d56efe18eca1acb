//! A plan as files: the manifest, tables, pictures.

mod cell;
pub mod files;
pub mod manifest;
mod outdated;
pub mod pictures;
pub mod share;
pub mod tables;
