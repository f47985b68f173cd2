//! The flash of a chip in a file: its raw contents, byte by byte, from the first address on.
//!
//! The file is replaced as a whole, by renaming, so that whoever reads it finds a state that the
//! flash has had; ending the program is cutting the power. What is reported on the bus as stored is
//! in the file before ([`FileFlash::is_urgent`]). A crash of the computer itself may cost more.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::task::Poll;
use std::time::{Duration, Instant};

use boot_core::flash::{Flash, FlashFault, Operation};
use shared_abi::geometry::{Geometry, Region, Sector};
use shared_abi::layout::Layout;

/// The duration of operations.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Speed {
    /// No time.
    Instant,
    /// The typical times in the datasheet of the STM32F405/407.
    Typical,
}

/// Typical erase times by the size of the sector (datasheet DocID022152, flash memory programming,
/// 32 bits at a time).
const ERASE: [(u32, Duration); 3] = [
    (16 * 1024, Duration::from_millis(250)),
    (64 * 1024, Duration::from_millis(550)),
    (128 * 1024, Duration::from_millis(1000)),
];
/// Typical time to program a word (the same table).
const PROGRAM: Duration = Duration::from_micros(16);
/// A host cannot wait for microseconds: words are programmed ahead of time after a wait, by at most
/// this time.
const CATCH_UP: Duration = Duration::from_millis(5);

/// A flash in a file.
#[derive(Debug)]
pub struct FileFlash {
    path: PathBuf,
    layout: &'static Layout,
    cells: Vec<u8>,
    speed: Speed,
    busy_until: Instant,
    /// The time since the file is older than the flash.
    unsaved: Option<Instant>,
    /// The changes include parameters.
    urgent: bool,
}

impl FileFlash {
    /// Loads the contents from the file. If the file does not exist, the flash is erased, and the
    /// file is created.
    ///
    /// # Errors
    /// The file cannot be read or created, or is not an image of this chip's flash.
    pub fn open(path: &Path, layout: &'static Layout, speed: Speed) -> io::Result<Self> {
        let chip = layout.chip;
        let size = chip.flash.size as usize;
        let found = match fs::metadata(path) {
            Ok(about) => Some(about.len()),
            Err(error) if error.kind() == io::ErrorKind::NotFound => None,
            Err(error) => return Err(error),
        };
        // The size is checked before reading: a file named by mistake may be large.
        let cells = match found {
            Some(length) if length == size as u64 => fs::read(path)?,
            Some(length) => return Err(wrong_size(length, chip)),
            None => vec![u8::MAX; size],
        };
        if cells.len() != size {
            return Err(wrong_size(cells.len() as u64, chip));
        }
        let now = Instant::now();
        let unsaved = found.is_none().then_some(now);
        let mut flash =
            Self { path: path.to_owned(), layout, cells, speed, busy_until: now, unsaved, urgent: false };
        flash.save()?;
        Ok(flash)
    }

    /// The file.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// How long the file has been older than the flash; `None` if it is up to date.
    #[must_use]
    pub fn unsaved(&self) -> Option<Duration> {
        self.unsaved.map(|since| since.elapsed())
    }

    /// Whether parameters have changed that are not in the file: node-ID and bit rate, or the
    /// record of a program.
    #[must_use]
    pub fn is_urgent(&self) -> bool {
        self.urgent
    }

    /// Writes the current contents to the file.
    ///
    /// # Errors
    /// The file cannot be written; the old file still exists.
    pub fn save(&mut self) -> io::Result<()> {
        if self.unsaved.is_none() {
            return Ok(());
        }
        let mut name = self.path.file_name().unwrap_or_default().to_owned();
        name.push(".new");
        let new = self.path.with_file_name(name);
        fs::write(&new, &self.cells)?;
        fs::rename(&new, &self.path)?;
        (self.unsaved, self.urgent) = (None, false);
        Ok(())
    }

    /// The place of a region in the file, if the region lies inside the flash.
    fn place(&self, region: Region) -> Option<std::ops::Range<usize>> {
        let flash = self.layout.chip.flash;
        let at = flash.contains(region.base, region.size).then(|| (region.base - flash.base) as usize)?;
        Some(at..at + region.size as usize)
    }

    fn is_busy(&self) -> bool {
        self.busy_until > Instant::now()
    }

    /// Starts an operation on this region that takes the time `takes`.
    fn begin(&mut self, region: Region, takes: Duration, ahead: Duration) -> Result<&mut [u8], FlashFault> {
        let place = self.place(region).filter(|_| !self.is_busy()).ok_or(FlashFault::Failed)?;
        let now = Instant::now();
        if self.speed == Speed::Typical {
            self.busy_until = self.busy_until.max(now.checked_sub(ahead).unwrap_or(now)) + takes;
        }
        self.unsaved.get_or_insert(now);
        self.urgent |= self.layout.parameters.iter().any(|home| home.overlaps(&region));
        Ok(&mut self.cells[place])
    }
}

fn wrong_size(length: u64, chip: &Geometry) -> io::Error {
    let (size, name) = (chip.flash.size, chip.chip);
    io::Error::new(
        io::ErrorKind::InvalidData,
        format!(
            "it has {length} bytes, and the flash of an {name} has {size}: name another file, or delete this one to start with erased flash"
        ),
    )
}

impl Flash for FileFlash {
    fn read(&self, address: u32, buffer: &mut [u8]) {
        for (i, byte) in buffer.iter_mut().enumerate() {
            let place = self.place(Region::new(address.wrapping_add(i as u32), 1));
            *byte = place.map_or(u8::MAX, |place| self.cells[place.start]);
        }
    }

    fn start(&mut self, operation: Operation) -> Result<(), FlashFault> {
        match operation {
            Operation::Erase(sector) => {
                if self.layout.chip.sector(sector.number) != Some(sector) {
                    return Err(FlashFault::Failed);
                }
                let of_size = ERASE.iter().find(|(size, _)| *size == sector.region.size);
                let takes = of_size.map_or(Duration::ZERO, |(_, takes)| *takes);
                self.begin(sector.region, takes, Duration::ZERO)?.fill(u8::MAX);
            }
            Operation::Program { address, .. } if !address.is_multiple_of(4) => {
                return Err(FlashFault::Failed);
            }
            Operation::Program { address, word } => {
                let cells = self.begin(Region::new(address, 4), PROGRAM, CATCH_UP)?;
                // Programming only changes ones to zeros; an impossible change is found when the
                // word is read back.
                for (cell, byte) in cells.iter_mut().zip(word.to_le_bytes()) {
                    *cell &= byte;
                }
            }
        }
        Ok(())
    }

    fn sector_at(&self, address: u32) -> Option<Sector> {
        self.layout.chip.sector_at(address)
    }

    fn poll(&mut self) -> Poll<Result<(), FlashFault>> {
        if self.is_busy() {
            Poll::Pending
        } else {
            Poll::Ready(Ok(()))
        }
    }
}

#[cfg(test)]
mod tests {
    use shared_abi::geometry::STM32F407VG;
    use shared_abi::layout::stm32f407g_disc1::LAYOUT;

    use super::*;

    fn file(test: &str) -> PathBuf {
        let folder = std::env::temp_dir().join(format!("coboot-node-{test}-{}", std::process::id()));
        let _ = fs::remove_dir_all(&folder);
        fs::create_dir_all(&folder).unwrap();
        folder.join("flash.bin")
    }

    fn open(path: &Path) -> FileFlash {
        FileFlash::open(path, &LAYOUT, Speed::Instant).unwrap()
    }

    /// RM0090 section 3.3: 1 MiB from 0800_0000h; an erased byte is FFh.
    #[test]
    fn a_new_file_is_an_erased_flash() {
        let path = file("new");
        let flash = open(&path);
        assert_eq!(fs::read(&path).unwrap(), vec![0xFF; 1 << 20]);
        let mut bytes = [0; 8];
        flash.read(0x080F_FFFC, &mut bytes);
        assert_eq!((bytes, flash.unsaved()), ([0xFF; 8], None));
        fs::remove_dir_all(path.parent().unwrap()).unwrap();
    }

    #[test]
    fn words_go_to_their_place_and_can_only_lose_bits() {
        let path = file("words");
        let mut flash = open(&path);
        flash.start(Operation::Program { address: 0x0801_0004, word: 0x4433_2211 }).unwrap();
        assert!(flash.poll().is_ready());
        flash.start(Operation::Program { address: 0x0801_0004, word: 0xF0FF_FFFF }).unwrap();
        assert_eq!(fs::read(&path).unwrap()[0x1_0004], 0xFF, "not before it is saved");
        assert!(flash.unsaved().is_some());
        assert!(!flash.is_urgent());
        flash.save().unwrap();
        let saved = fs::read(&path).unwrap();
        assert_eq!(saved[0x1_0003..0x1_0009], [0xFF, 0x11, 0x22, 0x33, 0x40, 0xFF]);
        // Another run finds this state; then one sector, number 4, is erased.
        let mut flash = open(&path);
        assert_eq!(flash.read_word(0x0801_0004), 0x4033_2211);
        flash.start(Operation::Program { address: 0x0802_0000, word: 0 }).unwrap();
        flash.start(Operation::Erase(STM32F407VG.sector(4).unwrap())).unwrap();
        assert_eq!(flash.read_word(0x0801_0004), u32::MAX);
        assert_eq!(flash.read_word(0x0802_0000), 0, "the next sector has not");
        // Parameters are in sectors 2 and 3.
        flash.start(Operation::Program { address: 0x0800_8000, word: 0 }).unwrap();
        assert!(flash.is_urgent());
        fs::remove_dir_all(path.parent().unwrap()).unwrap();
    }

    #[test]
    fn what_the_chip_cannot_do_fails() {
        let path = file("refused");
        let mut flash = open(&path);
        for address in [0x0801_0001, 0x07FF_FFFC, 0x0810_0000, u32::MAX - 3] {
            assert_eq!(
                flash.start(Operation::Program { address, word: 0 }),
                Err(FlashFault::Failed),
                "{address:08X}h"
            );
        }
        let foreign = Sector { number: 4, region: Region::new(0x0801_0000, 4) };
        assert_eq!(flash.start(Operation::Erase(foreign)), Err(FlashFault::Failed));
        assert!(flash.unsaved().is_none());
        fs::remove_dir_all(path.parent().unwrap()).unwrap();
    }

    #[test]
    fn an_operation_takes_its_time_and_bears_no_other() {
        let path = file("typical");
        let mut flash = FileFlash::open(&path, &LAYOUT, Speed::Typical).unwrap();
        let began = Instant::now();
        flash.start(Operation::Erase(STM32F407VG.sector(0).unwrap())).unwrap();
        assert!(flash.poll().is_pending());
        assert_eq!(
            flash.start(Operation::Program { address: 0x0801_0000, word: 0 }),
            Err(FlashFault::Failed)
        );
        while flash.poll().is_pending() {
            std::thread::sleep(Duration::from_millis(1));
        }
        // The datasheet's 250 ms; the host may notice it later.
        assert!(began.elapsed() >= Duration::from_millis(250));
        fs::remove_dir_all(path.parent().unwrap()).unwrap();
    }

    #[test]
    fn another_file_is_left_alone() {
        let path = file("foreign");
        for length in [0, 5, (1 << 20) + 1] {
            fs::write(&path, vec![7; length]).unwrap();
            let error = FileFlash::open(&path, &LAYOUT, Speed::Instant).unwrap_err();
            assert!(error.to_string().contains(&format!("it has {length} bytes")), "{error}");
            assert_eq!(fs::read(&path).unwrap(), vec![7; length]);
        }
        let error = FileFlash::open(path.parent().unwrap(), &LAYOUT, Speed::Instant).unwrap_err();
        assert!(!error.to_string().is_empty());
        fs::remove_dir_all(path.parent().unwrap()).unwrap();
    }
}
