//! What every floor may use and what knows none of them: errors, progress, large columns, parts of space, inner loops.

pub mod column;
pub mod connected;
pub mod error;
pub mod input;
pub mod large_pages;
pub mod progress;
pub mod shell;
pub mod tiles;
pub mod vector;
