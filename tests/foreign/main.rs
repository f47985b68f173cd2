//! What works with programs of others, unmodified: clients, debuggers, compilers, a browser.

mod block_upload;
mod clients;
mod eds;
mod examples;
#[cfg(unix)]
mod gdb_door;
#[cfg(unix)]
mod hosted;
#[cfg(target_os = "linux")]
mod pages;
mod peers;
mod python_package;
mod second_board;
mod ui;
