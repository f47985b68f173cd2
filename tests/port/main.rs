//! Other boards and other products: what a port has to do, and what it can combine.

#[cfg(reference_chip)]
mod can2;
mod can_driver;
#[cfg(reference_chip)]
mod matrix;
#[cfg(reference_board)]
mod porting;
#[cfg(reference_board)]
mod watchdog_chip;
