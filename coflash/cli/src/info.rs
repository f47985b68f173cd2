//! `coflash info`: shows what a device reports about itself.

use clap::Args;
use coflash_core::device::info::info;
use serde_json::json;

use super::context::Context;
use super::device::Device;
use super::output::Failure;

/// Shows what runs on a device, its identity and programs.
#[derive(Debug, Args)]
pub(super) struct Info {
    #[command(flatten)]
    device: Device,
}

impl Info {
    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        let mut link = context.link()?;
        let mut session = self.device.session(&mut link)?;
        let waiting = context.waiting(format!("node {} answers", session.node()));
        let info = info(&mut session).map_err(|error| Failure::diagnosed(error, &mut session))?;
        drop(waiting);
        context.result(&info, || json!(info));
        Ok(())
    }
}
