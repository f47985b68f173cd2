//! The firmware that is attacked, and the images that its masters send.

use boot_core::profile::Profile;
use bsp::NODE_ID;
use coflash::file::convert::{blocks_of, Options, Region};
use coflash::file::read::read;
use shared_abi::layout::stm32f407g_disc1_two::LAYOUT;
use shared_abi::layout::Layout;

use super::board::Board;
use super::line::SerialBoard;
use super::model::Node;
use super::target::Target;
use crate::firmware;

/// A program to send.
#[derive(Clone)]
pub struct Image {
    /// Its number.
    pub program: u8,
    /// The CRC of the program, from its block file and as a raw image.
    pub crcs: [u32; 2],
    /// The raw image.
    pub raw: Vec<u8>,
    /// The blocks of its block file, each a download.
    pub blocks: Vec<Vec<u8>>,
}

/// A device to attack.
#[derive(Clone)]
pub struct Setup {
    /// Its name.
    pub name: &'static str,
    /// The image of the bootloader.
    bootloader: &'static str,
    /// The layout of the board.
    pub layout: &'static Layout,
    /// The node-ID that the bootloader always has.
    pub fixed: Option<u8>,
    /// Node-ID and bit rate without stored values.
    pub default: Node,
    /// 1000h of the bootloader.
    pub device_type: u32,
    /// The object for the password of a program, and the password.
    pub password: Option<(u16, &'static [u8])>,
    /// The program that is data.
    pub data: Option<u8>,
    /// A downloaded program starts by itself.
    pub starts_by_itself: bool,
    /// The programs.
    pub images: Vec<Image>,
}

impl Image {
    fn new(program: u8, name: &str) -> Self {
        let name = firmware::of_board(LAYOUT.board, name);
        let region = LAYOUT.programs[usize::from(program) - 1];
        // Smaller blocks than the default: there is more between them.
        let options = Options::default().region(Region::Strict(region.into())).block_size(2048);
        let file = blocks_of(read(&firmware::elf(&name), None, None).expect("an ELF of ours"), &options);
        let file = file.expect("it fits").file;
        let raw = firmware::raw_from(region.base, &name);
        Self {
            program,
            crcs: [file.program_crc(), crate::sealed::crc32(&raw)],
            raw,
            blocks: file.blocks().iter().map(|block| block.emit()).collect(),
        }
    }
}

impl Setup {
    /// All setups, on the board with two programs; none if the tests run for another chip.
    #[must_use]
    pub fn all() -> Vec<Self> {
        if firmware::board().chip != LAYOUT.chip {
            println!("not run: {} has the chip of another board", LAYOUT.board);
            return Vec::new();
        }
        let applications = [(1, firmware::APP_V1), (1, firmware::APP_V2), (2, firmware::PROGRAM_2)];
        vec![
            Self::of("standard", firmware::BOOTLOADER, &Profile::STANDARD, &applications),
            Self::of("esacademy", firmware::BOOTLOADER_ESACADEMY, &Profile::ESACADEMY, &applications),
            Self::of(
                "lift",
                firmware::BOOTLOADER_LIFT,
                &Profile::LIFT,
                &[(1, firmware::APP_LIFT[0]), (1, firmware::APP_LIFT[1])],
            ),
            Self::of("sealed", firmware::BOOTLOADER_SEALED, &Profile::STANDARD, &applications),
            Self::of(
                "serial",
                firmware::BOOTLOADER_VIRTUAL_CAN,
                &Profile::STANDARD,
                &[(1, firmware::APP_VIRTUAL_CAN), (1, "app-virtual-can-v2.elf")],
            ),
        ]
    }

    fn of(
        name: &'static str,
        bootloader: &'static str,
        profile: &Profile,
        images: &[(u8, &'static str)],
    ) -> Self {
        use boot_core::bootloader::PasswordObject;
        let default = profile.default_node.map_or((NODE_ID, 4), |(id, rate)| (id.get(), rate as u8));
        Self {
            name,
            bootloader,
            layout: &LAYOUT,
            fixed: profile.node_id.map(canopen::NodeId::get),
            default,
            device_type: profile.device_type,
            password: match profile.extras.password {
                PasswordObject::None => None,
                PasswordObject::EnableFlash => Some((0x7F50, profile.password)),
                PasswordObject::Unlock => Some((0x6005, profile.password)),
            },
            data: profile.download.data,
            starts_by_itself: profile.download.starts_by_itself,
            images: images.iter().map(|(program, name)| Image::new(*program, name)).collect(),
        }
    }

    /// A board with this firmware, switched on.
    #[must_use]
    pub fn target(&self) -> Box<dyn Target> {
        let bootloader = firmware::of_board(self.layout.board, self.bootloader);
        if self.bootloader == firmware::BOOTLOADER_VIRTUAL_CAN {
            Box::new(SerialBoard::new(self.layout, &bootloader))
        } else {
            Box::new(Board::new(self.layout, &bootloader))
        }
    }
}
