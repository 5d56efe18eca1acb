#![no_main]
#[path = "../readers.rs"]
mod readers;

use std::sync::LazyLock;

static FILES: LazyLock<readers::Files> = LazyLock::new(|| readers::model(true));

libfuzzer_sys::fuzz_target!(|data: &[u8]| readers::replace("images.txt", data, &FILES));
