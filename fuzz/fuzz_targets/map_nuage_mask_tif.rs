#![no_main]
#[path = "../inputs.rs"]
mod inputs;

libfuzzer_sys::fuzz_target!(|data: &[u8]| _ = inputs::read_input("map.nuage.mask.tif", data));
