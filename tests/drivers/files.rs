//! The trait `Flash` over files: the example of `docs/operating-system.md`. A sector is a file, an erased
//! sector has none, and what an operation has reported as done is on the disk.

use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::task::Poll;

use boot_core::flash::{Flash, FlashFault, Operation};
use shared_abi::geometry::{Geometry, Sector};

/// A flash in the files of a folder.
pub struct Files {
    folder: PathBuf,
    /// The addresses and sectors that the bootloader knows.
    shape: &'static Geometry,
    /// Why the last operation failed: the trait has only the kinds of a flash controller.
    error: Option<io::Error>,
}

impl Files {
    /// Uses a folder, which may be empty.
    ///
    /// # Errors
    /// The folder cannot be made.
    pub fn open(folder: &Path, shape: &'static Geometry) -> io::Result<Self> {
        fs::create_dir_all(folder)?;
        Ok(Self { folder: folder.to_owned(), shape, error: None })
    }

    /// Why the last operation failed, for a log.
    pub fn error(&self) -> Option<&io::Error> {
        self.error.as_ref()
    }

    fn path(&self, sector: Sector) -> PathBuf {
        self.folder.join(format!("sector-{}", sector.number))
    }

    fn erase(&self, sector: Sector) -> io::Result<()> {
        match fs::remove_file(self.path(sector)) {
            Err(error) if error.kind() != ErrorKind::NotFound => Err(error),
            // The folder has the names of its files.
            _ => File::open(&self.folder)?.sync_all(),
        }
    }

    fn program(&self, sector: Sector, address: u32, word: u32) -> io::Result<()> {
        let path = self.path(sector);
        if !path.exists() {
            // A file that is there is whole: a crash leaves the old state or this one.
            let new = path.with_extension("new");
            fs::write(&new, vec![u8::MAX; sector.region.size as usize])?;
            File::open(&new)?.sync_all()?;
            fs::rename(&new, &path)?;
            File::open(&self.folder)?.sync_all()?;
        }
        let mut file = OpenOptions::new().read(true).write(true).open(&path)?;
        let place = SeekFrom::Start(u64::from(address - sector.region.base));
        let mut before = [0; 4];
        file.seek(place)?;
        file.read_exact(&mut before)?;
        file.seek(place)?;
        // Like a flash: bits only become 0. The bootloader reads back what it has written.
        file.write_all(&(u32::from_le_bytes(before) & word).to_le_bytes())?;
        file.sync_data()
    }

    fn read_sector(&self, sector: Sector, offset: u32, buffer: &mut [u8]) -> io::Result<()> {
        let mut file = File::open(self.path(sector))?;
        file.seek(SeekFrom::Start(offset.into()))?;
        file.read_exact(buffer)
    }
}

impl Flash for Files {
    fn read(&self, address: u32, buffer: &mut [u8]) {
        let mut at = address;
        let mut remaining = buffer;
        while !remaining.is_empty() {
            let sector = self.sector_at(at);
            let left = sector.map_or(1, |sector| sector.region.end() - at);
            let (part, after) = remaining.split_at_mut(remaining.len().min(left as usize));
            let read = sector.map(|sector| self.read_sector(sector, at - sector.region.base, part));
            if !matches!(read, Some(Ok(()))) {
                // Erased, outside, or unreadable: the CRC of what was there is wrong then.
                part.fill(u8::MAX);
            }
            at = at.wrapping_add(part.len() as u32);
            remaining = after;
        }
    }

    /// The operation is over when this returns, so [`poll`](Self::poll) has nothing to wait for. A
    /// thread of its own for the disk would let the bus go on meanwhile.
    fn start(&mut self, operation: Operation) -> Result<(), FlashFault> {
        let done = match operation {
            Operation::Erase(sector) if self.shape.sector(sector.number) == Some(sector) => {
                self.erase(sector)
            }
            Operation::Program { address, word } if address.is_multiple_of(4) => {
                match self.sector_at(address) {
                    Some(sector) => self.program(sector, address, word),
                    None => return Err(FlashFault::Failed),
                }
            }
            _ => return Err(FlashFault::Failed),
        };
        self.error = done.err();
        match &self.error {
            None => Ok(()),
            Some(error) if error.kind() == ErrorKind::PermissionDenied => Err(FlashFault::Protected),
            Some(_) => Err(FlashFault::Failed),
        }
    }

    fn poll(&mut self) -> Poll<Result<(), FlashFault>> {
        Poll::Ready(Ok(()))
    }

    fn sector_at(&self, address: u32) -> Option<Sector> {
        self.shape.sector_at(address)
    }
}

mod tests {
    use boot_core::control::Step;
    use boot_core::crc::CrcKind;
    use boot_core::program::verify;
    use boot_core::store::Journal;
    use canopen::od::{Address, Objects};
    use kit::bench::{block_file, node, program, CLEAR, CONFIG, LAYOUT, SET_SIGNATURE};
    use kit::boot::{leaked, Boot};
    use kit::driver::{demonstrate, Place};
    use kit::folder::Folder;
    use kit::model::CHIP;
    use shared_abi::geometry::Region;

    use super::*;

    fn folder(test: &str) -> Folder {
        Folder::below(env!("CARGO_TARGET_TMPDIR"), test)
    }

    #[test]
    fn files_pass_the_demonstration() {
        let folder = folder("files-pass");
        let mut files = Files::open(&folder, &CHIP).unwrap();
        let sector = CHIP.sector(5).unwrap();
        let around = Region::new(CHIP.flash.base, sector.region.base - CHIP.flash.base);
        let place = Place { sector, around, foreign: 0x2000_0000, polls: 1 };
        assert_eq!(demonstrate(&mut files, &place), Ok(()));
        assert!(!folder.join("sector-5").exists(), "an erased sector has no file");
    }

    /// A program arrives, and is found by the next process over the same files.
    #[test]
    fn a_program_is_installed_in_files() {
        let folder = folder("files-installed");
        let image = program(1000, 0x22);
        {
            let files = Files::open(&folder, &CHIP).unwrap();
            let (buffer, sealed) = leaked(256);
            let mut device: boot_core::bootloader::Bootloader<'_, _, _, 1> =
                Boot::new(&CONFIG, node()).on(files, buffer, sealed);
            let mut write = |at: Address, bytes: &[u8]| {
                if at.index == 0x1F51 {
                    device.write(at, bytes).unwrap();
                } else {
                    device.download_start(at, Some(bytes.len() as u32)).unwrap();
                    device.download_data(at, bytes).unwrap();
                    device.download_end(at).unwrap();
                }
                while device.step() != Step::Idle {}
                let mut status = [0; 4];
                device.read(Address::new(0x1F57, 1), &mut status).unwrap();
                assert_eq!(status, [0; 4], "{at:?}");
            };
            write(Address::new(0x1F51, 1), &[CLEAR]);
            for block in block_file(&image, 96) {
                write(Address::new(0x1F50, 1), &block);
            }
            write(Address::new(0x1F51, 1), &[SET_SIGNATURE]);
        }
        let files = Files::open(&folder, &CHIP).unwrap();
        let journal = Journal::open(&files, LAYOUT.parameters);
        let found = verify(&files, &journal, &LAYOUT, CrcKind::Crc32, 1).unwrap();
        assert!(found.signed);
        let mut bytes = vec![0; image.len()];
        files.read(LAYOUT.programs[0].base, &mut bytes);
        assert!(bytes == image);
    }

    /// What the system refuses is a fault of the flash, and its words are kept.
    #[test]
    fn a_folder_that_is_gone_is_a_fault_with_its_reason() {
        let folder = folder("files-gone");
        let gone = folder.join("gone");
        let mut files = Files::open(&gone, &CHIP).unwrap();
        fs::remove_dir(&gone).unwrap();
        let word = Operation::Program { address: CHIP.flash.base, word: 0 };
        assert_eq!(files.start(word), Err(FlashFault::Failed));
        assert_eq!(files.error().map(io::Error::kind), Some(ErrorKind::NotFound));
        let mut bytes = [0; 4];
        files.read(CHIP.flash.base, &mut bytes);
        assert_eq!(bytes, [0xFF; 4]);
        // A sector whose file is shorter than it must be reads as erased: its CRC is wrong.
        fs::create_dir(&gone).unwrap();
        fs::write(gone.join("sector-0"), b"short").unwrap();
        files.read(CHIP.flash.base + 4, &mut bytes);
        assert_eq!(bytes, [0xFF; 4]);
        assert_eq!(
            files.start(Operation::Program { address: CHIP.flash.base + 8, word: 0 }),
            Err(FlashFault::Failed)
        );
        assert_eq!(files.error().map(io::Error::kind), Some(ErrorKind::UnexpectedEof));
        // No file is outside the folder, whatever the operation says.
        let foreign = Sector { number: 200, ..CHIP.sector(0).unwrap() };
        assert_eq!(files.start(Operation::Erase(foreign)), Err(FlashFault::Failed));
    }
}
