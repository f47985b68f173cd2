//! Updates: program download in each dialect, what ends one, and what happens then.

mod attacker;
mod choices;
mod coflash_dialects;
mod conform;
mod dialects;
mod fleet;
mod main_job;
mod masters;
mod powercut;
mod powercut_board;
mod recording;
mod renewal;
mod renewal_states;
mod resume;
mod streams;
mod throughput;
mod two_programs;
