//! Other boards and other products: what a port has to do, and what it can combine.

mod can2;
mod can_driver;
mod matrix;
mod porting;
