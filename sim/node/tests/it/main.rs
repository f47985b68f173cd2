//! Nodes as their users run them, with the host tool and its library; and the update in virtual time
//! with cuts.

mod agent;
mod bus;
mod commands;
mod conform;
mod cut;
mod cuts;
#[cfg(unix)]
mod hosted;
mod machine;
mod nodes;
#[cfg(unix)]
mod outcomes;
mod pages;
mod production_line;
mod service;
