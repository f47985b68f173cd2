//! `coflash info`: what a device says about itself.

use clap::Args;
use coflash::info::info;

use super::{Bus, Device, Failure};

/// Shows what runs on a device, its identity, and the state of its programs.
#[derive(Debug, Args)]
pub(super) struct Info {
    #[command(flatten)]
    device: Device,
}

impl Info {
    pub(super) fn run(&self, bus: &Bus) -> Result<(), Failure> {
        let mut adapter = bus.open()?;
        let mut session = self.device.session(&mut *adapter)?;
        say!("{}", info(&mut session)?.to_string().trim_end());
        Ok(())
    }
}
