//! Other boards and other products: what a port has to do, and what it can combine.

mod can2;
mod can_driver;
#[cfg(split_map)]
mod matrix;
#[cfg(reference_board)]
mod porting;
