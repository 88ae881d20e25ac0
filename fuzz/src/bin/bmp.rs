//! Random files with the suffix .bmp.

#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| equipix_fuzz::read("bmp", data));
