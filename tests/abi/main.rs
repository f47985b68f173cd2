//! The ABI between bootloader, application and tools, on the host: the layout of its structures, the
//! C header, and the way back into the bootloader in C; and two pages, with the names of the manuals
//! and with the figures of others. It needs no image and no emulator.

mod compare;
mod compiler;
mod header;
mod layout;
mod manuals;
mod numbers;
mod old_and_new;
mod reentry;
