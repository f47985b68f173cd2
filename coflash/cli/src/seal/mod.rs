//! `coflash seal`: keys, sealed images, and devices that accept nothing else.

pub(crate) mod access;
pub(crate) mod factory;
pub(crate) mod image;
pub(crate) mod keys;
pub(crate) mod nameplate;
pub(crate) mod provision;
pub(crate) mod verify;
pub(crate) mod verify_device;

use clap::Subcommand;

use crate::context::Context;
use crate::output::Failure;

/// Makes keys and sealed images, manages their devices.
#[derive(Debug, Subcommand)]
pub(crate) enum Seal {
    Keys(keys::Keys),
    Image(Box<image::Image>),
    Show(verify::Show),
    Verify(Box<verify::Verify>),
    VerifyDevice(verify_device::VerifyDevice),
    Provision(provision::Provision),
    Nameplate(nameplate::MakeNameplate),
    Factory(Box<factory::Factory>),
    Unlock(access::Unlock),
    Events(access::Events),
}

impl Seal {
    /// Whether the command talks to a device.
    pub(crate) fn takes_a_bus(&self) -> bool {
        matches!(self, Self::VerifyDevice(_) | Self::Unlock(_) | Self::Events(_))
    }

    pub(crate) fn run(&self, context: &Context) -> Result<(), Failure> {
        match self {
            Self::Keys(keys) => keys.run(context),
            Self::Image(image) => image.run(context),
            Self::Show(show) => show.run(context),
            Self::Verify(verify) => verify.run(context),
            Self::VerifyDevice(verify) => verify.run(context),
            Self::Provision(provision) => provision.run(context),
            Self::Nameplate(nameplate) => nameplate.run(context),
            Self::Factory(factory) => factory.run(context),
            Self::Unlock(unlock) => unlock.run(context),
            Self::Events(events) => events.run(context),
        }
    }
}
