//! Foundations that all layers share: errors, progress, input files, paths, platform differences,
//! bounds of pixels, large columns, packed lists, sets of bits, CSR offsets, nearest points, tiles
//! of space, vectorised loops.

pub mod bits;
pub mod column;
pub mod connected;
pub mod error;
pub mod input;
pub mod kd_tree;
pub mod large_pages;
pub mod packed;
pub mod paths;
pub mod pixels;
pub mod platform;
pub mod progress;
pub mod rows;
pub mod shell;
pub mod tiles;
pub mod vector;
