//! Foundations that all floors share: errors, progress, amounts with units, digits and medians of
//! numbers, bounds of pixels, large columns, sets of bits, CSR offsets, nearest points, tiles of
//! space, vectorised loops.

pub mod amounts;
pub mod bits;
pub mod column;
pub mod connected;
pub mod decimals;
pub mod error;
pub mod kd_tree;
pub mod large_pages;
pub mod median;
pub mod pixels;
pub mod progress;
pub mod rows;
pub mod tiles;
pub mod vector;
