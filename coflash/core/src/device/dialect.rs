//! Dialects: the ways in which different bootloaders use the same objects.
//!
//! This module lists the dialects and detects them from the device type. The commands of each
//! dialect during an update are in [`update::dialect`](crate::update::dialect).

use std::fmt;

use canopen::program::{self, ESACADEMY_DEVICE_TYPE, LIFT_DEVICE_TYPE, LIFT_NODE_ID};
use canopen::NodeId;
use serde::{Serialize, Serializer};

use super::device_type::DeviceType;

/// The form in which a program goes to a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// The blocks of a block file.
    Blocks,
    /// The contents of the flash, from the program's start on.
    Image,
    /// Intel HEX text.
    Hex,
}

/// What there is to know about a dialect besides its procedure.
#[derive(Clone, Copy)]
struct Row {
    name: &'static str,
    words: &'static str,
    help: &'static str,
    form: Form,
    password: bool,
}

/// Defines the dialects: a row for each.
macro_rules! dialects {
    ($($(#[$doc:meta])* $dialect:ident $row:tt)+) => {
        /// The dialect of a bootloader.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum Dialect {
            $($(#[$doc])* $dialect,)+
        }

        impl Dialect {
            /// All dialects.
            pub const ALL: [Dialect; [$(Dialect::$dialect),+].len()] = [$(Dialect::$dialect),+];

            const fn row(self) -> Row {
                match self {
                    $(Dialect::$dialect => Row $row,)+
                }
            }
        }
    };
}

dialects! {
    /// Block files: the dialect of SYS TEC and of coboot.
    Block {
        name: "block", words: "block files, SYS TEC", form: Form::Blocks, password: false,
        help: "Block files, as SYS TEC's tools send them",
    }
    /// CiA 302-3 with a binary image.
    Raw {
        name: "raw", words: "CiA 302-3, an image", form: Form::Image, password: false,
        help: "An image in one download (CiA 302-3)",
    }
    /// CiA 302-3 with Intel HEX.
    Hex {
        name: "hex", words: "CiA 302-3, Intel HEX", form: Form::Hex, password: false,
        help: "Intel HEX in one download (CiA 302-3)",
    }
    /// CiA 417, as CiA 814-1 describes it.
    Lift {
        name: "lift", words: "CiA 417", form: Form::Image, password: true,
        help: "CiA 417: a password in 6005h, then an image at node-ID 126",
    }
    /// ESAcademy's minimal boot loader.
    EsAcademy {
        name: "esacademy", words: "Intel HEX behind a password", form: Form::Hex, password: true,
        help: "Intel HEX behind a password in 7F50h, as ESAcademy describes it",
    }
}

impl Dialect {
    /// The name on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        self.row().name
    }

    /// A line of help.
    #[must_use]
    pub const fn help(self) -> &'static str {
        self.row().help
    }

    /// The form of a program.
    #[must_use]
    pub const fn form(self) -> Form {
        self.row().form
    }

    /// Whether its devices are locked by a password.
    #[must_use]
    pub const fn has_password(self) -> bool {
        self.row().password
    }

    /// The dialect with this name.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|dialect| dialect.name() == name)
    }

    /// The dialect of a bootloader with this device type at this node-ID; `None` for an application
    /// or an unknown device type.
    #[must_use]
    pub fn of_bootloader(running: DeviceType, node: NodeId) -> Option<Self> {
        match running.0 {
            program::BOOTLOADER_DEVICE_TYPE => Some(Self::Block),
            LIFT_DEVICE_TYPE => Some(Self::Lift),
            ESACADEMY_DEVICE_TYPE if node.get() == LIFT_NODE_ID => Some(Self::Lift),
            ESACADEMY_DEVICE_TYPE => Some(Self::EsAcademy),
            _ => None,
        }
    }
}

impl fmt::Display for Dialect {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Row { name, words, .. } = self.row();
        write!(f, "{name} ({words})")
    }
}

impl Serialize for Dialect {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}
