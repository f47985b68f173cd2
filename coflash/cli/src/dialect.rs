//! `--dialect` and `--unlock`: the dialect of a bootloader, and its password.

use clap::{Args, ValueEnum};
use coflash_core::device::Dialect;
use coflash_core::update::Password;

/// How to handle devices of other makers.
#[derive(Debug, Args)]
pub(super) struct Access {
    /// The dialect of the bootloader.
    #[arg(long, value_name = "DIALECT", value_enum, default_value = "auto")]
    dialect: Name,

    /// The password of a locked device: a text for lift; for esacademy a number like 0x494E4954 or
    /// its four characters, in place of the default password.
    #[arg(long, value_name = "PASSWORD", env = "COFLASH_UNLOCK", hide_env_values = true, value_parser = password)]
    unlock: Option<Password>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Name {
    /// Detect it by the device type and the objects of the device.
    Auto,
    /// Block files, as SYS TEC's tools send them.
    Block,
    /// An image in one download (CiA 302-3).
    Raw,
    /// Intel HEX in one download (CiA 302-3).
    Hex,
    /// CiA 417: a password in 6005h, then an image at node-ID 126.
    Lift,
    /// Intel HEX behind a password in 7F50h, as ESAcademy describes it.
    Esacademy,
}

impl Access {
    /// The dialect; `None` to detect it.
    pub(super) fn dialect(&self) -> Option<Dialect> {
        match self.dialect {
            Name::Auto => None,
            Name::Block => Some(Dialect::Block),
            Name::Raw => Some(Dialect::Raw),
            Name::Hex => Some(Dialect::Hex),
            Name::Lift => Some(Dialect::Lift),
            Name::Esacademy => Some(Dialect::EsAcademy),
        }
    }

    pub(super) fn unlock(&self) -> Option<Password> {
        self.unlock
    }
}

fn password(text: &str) -> Result<Password, String> {
    Password::new(text).ok_or_else(|| "a password has 1 to 64 bytes".to_string())
}
