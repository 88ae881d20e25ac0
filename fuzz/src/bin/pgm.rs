//! Random files with the suffix .pgm.

#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| equipix_fuzz::read("pgm", data));
