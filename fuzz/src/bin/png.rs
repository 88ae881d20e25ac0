//! Random files with the suffix .png.

#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| equipix_fuzz::read("png", data));
