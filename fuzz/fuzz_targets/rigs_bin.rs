#![no_main]
#[path = "../readers.rs"]
mod readers;

use std::sync::LazyLock;

static FILES: LazyLock<readers::Files> = LazyLock::new(|| readers::model(false));

libfuzzer_sys::fuzz_target!(|data: &[u8]| readers::replace("rigs.bin", data, &FILES));
