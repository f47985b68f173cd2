//! The tests of the emulator from outside, as one program.

mod assembler;
mod emulate;
mod machine;
mod second_opinion;
