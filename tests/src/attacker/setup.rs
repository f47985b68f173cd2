//! The firmware that is attacked, and the images that its masters send.

use boot_core::profile::Profile;
use bsp::NODE_ID;
use coflash_core::file::block_file::BlockFile;
use coflash_core::file::convert::{program_of, Options, Region};
use coflash_core::file::read::read;
use coflash_core::file::sealed::Sealer;
use shared_abi::layout::stm32f407g_disc1_two::LAYOUT;
use shared_abi::layout::Layout;

use super::board::Board;
use super::line::SerialBoard;
use super::model;
use super::target::Target;
use crate::firmware;
use crate::sealed_board::{keys, release, sealer, COUNTER, KEKS};

/// A program to send.
#[derive(Clone)]
pub struct Image {
    /// Its number.
    pub program: u8,
    /// The CRCs that its program may have: from its block file, and as a raw image. None if a device
    /// must not accept it.
    pub crcs: Vec<u32>,
    /// What is sent in one download: the raw image, or the sealed one.
    pub whole: Vec<u8>,
    /// The blocks of its block file, each a download.
    pub blocks: Vec<Vec<u8>>,
}

/// What is attacked.
#[derive(Clone, Copy)]
enum Device {
    /// The emulated board with the image of this bootloader.
    Image(&'static str),
    /// The emulated board with the bootloader for sealed images, and with keys.
    Sealed,
    /// `coboot-node`.
    Node(&'static Profile),
}

/// A device to attack.
#[derive(Clone)]
pub struct Setup {
    /// Its name.
    pub name: &'static str,
    device: Device,
    /// The layout of the board.
    pub layout: &'static Layout,
    /// The node-ID that the bootloader always has.
    pub fixed: Option<u8>,
    /// Node-ID and bit rate without stored values.
    pub default: model::Node,
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
        let file = program_of(read(&firmware::elf(&name), None, None).expect("an ELF of ours"), &options);
        let file = file.expect("it fits").program;
        let raw = firmware::raw_from(region.base, &name);
        Self {
            program,
            crcs: vec![file.crc(), crate::sealed::crc32(&raw)],
            whole: raw,
            blocks: BlockFile::of(&file).blocks().iter().map(|block| block.emit()).collect(),
        }
    }

    /// The same for a device that accepts only sealed images.
    fn refused(self) -> Self {
        Self { crcs: Vec::new(), ..self }
    }

    /// The same as an image that such a device accepts, in all kinds of payload.
    fn sealed(self, encrypted: bool, compress: bool) -> Self {
        let encrypt_for: &[_] = if encrypted { &*KEKS } else { &[] };
        let sealer = Sealer { program: self.program, encrypt_for, compress, ..sealer(COUNTER) };
        let whole = sealer.seal(&self.whole, &release()).expect("it can be sealed");
        let crcs = vec![crate::sealed::crc32(&self.whole)];
        Self { crcs, blocks: vec![whole.clone()], whole, ..self }
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
        let image =
            |name, image, profile, images: &[_]| Self::of(name, Device::Image(image), profile, images);
        let node = |name, profile, images: &[_]| Self::of(name, Device::Node(profile), profile, images);
        let lift = firmware::APP_LIFT.map(|image| (1, image));
        let applications = [(1, firmware::APP_V1), (1, firmware::APP_V2), (2, firmware::PROGRAM_2)];
        let mut sealed = Self::of("keys", Device::Sealed, &Profile::STANDARD, &applications);
        let kinds = [(false, false), (true, true), (true, false)];
        for (image, (encrypted, compress)) in sealed.images.iter_mut().zip(kinds) {
            *image = image.clone().sealed(encrypted, compress);
        }
        sealed.images.push(Image::new(1, firmware::APP_LIFT[0]).refused());
        vec![
            sealed,
            image("standard", firmware::BOOTLOADER, &Profile::STANDARD, &applications),
            image("esacademy", firmware::BOOTLOADER_ESACADEMY, &Profile::ESACADEMY, &applications),
            image("lift", firmware::BOOTLOADER_LIFT, &Profile::LIFT, &lift),
            image("sealed", firmware::BOOTLOADER_SEALED, &Profile::STANDARD, &applications),
            image(
                "serial",
                firmware::BOOTLOADER_VIRTUAL_CAN,
                &Profile::STANDARD,
                &[(1, firmware::APP_VIRTUAL_CAN), (1, "app-virtual-can-v2.elf")],
            ),
            node("node", &Profile::STANDARD, &applications),
            node("node-esacademy", &Profile::ESACADEMY, &applications),
            node("node-lift", &Profile::LIFT, &lift),
        ]
    }

    fn of(
        name: &'static str,
        device: Device,
        profile: &'static Profile,
        images: &[(u8, &'static str)],
    ) -> Self {
        use boot_core::bootloader::PasswordObject;
        let default = profile.default_node.map_or((NODE_ID, 4), |(id, rate)| (id.get(), rate as u8));
        Self {
            name,
            device,
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

    /// Whether it may wait with a reset that was asked for: it would end the wait after a wrong password or
    /// signature.
    #[must_use]
    pub fn delays_resets(&self) -> bool {
        self.password.is_some() || matches!(self.device, Device::Sealed)
    }

    /// How many frames it takes in the time of one on an emulated board, at least.
    #[must_use]
    pub fn pace(&self) -> u64 {
        match self.device {
            Device::Image(_) | Device::Sealed => 1,
            Device::Node(_) => 20,
        }
    }

    /// Such a device, switched on.
    #[must_use]
    pub fn target(&self) -> Box<dyn Target> {
        let of_board = |image| firmware::of_board(self.layout.board, image);
        match self.device {
            Device::Node(profile) => Box::new(super::node::Node::new(profile)),
            Device::Image(image @ firmware::BOOTLOADER_VIRTUAL_CAN) => {
                Box::new(SerialBoard::new(self.layout, &of_board(image)))
            }
            Device::Image(image) => Box::new(Board::new(self.layout, &of_board(image), &[])),
            Device::Sealed => {
                Box::new(Board::new(self.layout, &of_board(firmware::BOOTLOADER_SEALED), &keys()))
            }
        }
    }
}
