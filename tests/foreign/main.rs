//! What works with programs of others, unmodified: clients, debuggers, compilers, a browser.

mod clients;
mod eds;
#[cfg(reference_board)]
mod examples;
#[cfg(all(unix, split_map))]
mod gdb_door;
#[cfg(unix)]
mod hosted;
#[cfg(all(target_os = "linux", reference_board))]
mod pages;
#[cfg(split_map)]
mod peers;
#[cfg(reference_board)]
mod python_package;
mod second_board;
mod ui;
