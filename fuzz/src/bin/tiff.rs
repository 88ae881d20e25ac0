//! Random files with the suffix .tif.

#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| equipix_fuzz::read("tif", data));
