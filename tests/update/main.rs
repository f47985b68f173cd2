//! Updates: program download in each dialect, what ends one, and what happens then.

#[cfg(split_map)]
mod attacker;
mod choices;
mod coflash_dialects;
mod conform;
mod dialects;
#[cfg(split_map)]
mod fleet;
mod main_job;
mod masters;
mod powercut_board;
#[cfg(reference_board)]
mod recording;
#[cfg(staging)]
mod renewal;
#[cfg(split_map)]
mod resume;
mod streams;
mod throughput;
mod two_programs;
