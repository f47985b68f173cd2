//! The bootloader's products in this repository, with their names.

// What the file of a product has from the library that it is a module of.
use product::*;

// The modules, and the list `ALL` (build.rs).
include!(concat!(env!("OUT_DIR"), "/products.rs"));
