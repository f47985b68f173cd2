//! `--dialect` and `--unlock`: the dialect of a bootloader, and its password.

use clap::builder::PossibleValue;
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

/// A dialect, or none: then it is detected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Name(Option<Dialect>);

impl Name {
    const ALL: [Self; Dialect::ALL.len() + 1] = {
        let mut names = [Self(None); Dialect::ALL.len() + 1];
        let mut at = 0;
        while at < Dialect::ALL.len() {
            names[at + 1] = Self(Some(Dialect::ALL[at]));
            at += 1;
        }
        names
    };
}

impl ValueEnum for Name {
    fn value_variants<'a>() -> &'a [Self] {
        &Self::ALL
    }

    fn to_possible_value(&self) -> Option<PossibleValue> {
        let (name, help) = match self.0 {
            None => ("auto", "Detect it by the device type and the objects of the device"),
            Some(dialect) => (dialect.name(), dialect.help()),
        };
        Some(PossibleValue::new(name).help(help))
    }
}

impl Access {
    /// The dialect; `None` to detect it.
    pub(super) fn dialect(&self) -> Option<Dialect> {
        self.dialect.0
    }

    pub(super) fn unlock(&self) -> Option<Password> {
        self.unlock
    }
}

fn password(text: &str) -> Result<Password, String> {
    Password::new(text).ok_or_else(|| "a password has 1 to 64 bytes".to_string())
}
