//! Tests that take ten seconds or more: `cargo test --test slow`.

mod daemon_kill;
mod fuzz_readers;
mod races;
mod tiles;
