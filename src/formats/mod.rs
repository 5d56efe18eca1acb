//! File formats of sparse models, one file each: bytes <-> [`crate::scene::Scene`], no file system logic.
