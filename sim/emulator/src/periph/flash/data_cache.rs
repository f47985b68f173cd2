//! The data cache of the flash interface: 8 lines of 128 bits, the least recently used one is replaced
//! (RM0090 section 3.5.2).
//!
//! Programming changes the data in the cache, too; an erase does not, so that software has to flush the
//! cache, which works only while it is disabled (section 3.6.4, programming and caches).
//!
//! What the CPU reads is the array's memory itself. While a line is stale, the array has the stale
//! bytes in its place, and this module keeps the true ones.

use std::collections::BTreeMap;

use super::cells::Operation;

/// Bytes of a line.
const LINE: u32 = 16;
/// How many there are.
const LINES: usize = 8;

/// FLASH_ACR.
const DCEN: u32 = 1 << 10;
const DCRST: u32 = 1 << 12;

type Bytes = [u8; LINE as usize];

struct Line {
    offset: u32,
    bytes: Bytes,
}

/// The cache.
#[derive(Default)]
pub struct DataCache {
    is_enabled: bool,
    /// The least recently used one first.
    lines: Vec<Line>,
    /// The true bytes of the stale lines, by their offsets.
    hidden: BTreeMap<u32, Bytes>,
}

fn bytes_at(array: &[u8], offset: u32) -> Bytes {
    let at = offset as usize;
    array[at..at + LINE as usize].try_into().expect("a line")
}

fn put(array: &mut [u8], offset: u32, bytes: &Bytes, changed: &mut Vec<(u32, u32)>) {
    let at = offset as usize;
    array[at..at + LINE as usize].copy_from_slice(bytes);
    changed.push((offset, LINE));
}

impl DataCache {
    /// Whether loads come by the cache.
    pub fn is_enabled(&self) -> bool {
        self.is_enabled
    }

    /// FLASH_ACR is written. Call it between [`Self::show_array`] and [`Self::show_lines`].
    pub fn control(&mut self, acr: u32) {
        self.is_enabled = acr & DCEN != 0;
        if !self.is_enabled && acr & DCRST != 0 {
            self.lines.clear();
        }
    }

    /// A reset: nothing is in the cache, and it is disabled. The array is whole.
    pub fn reset(&mut self) {
        self.is_enabled = false;
        self.lines.clear();
    }

    /// The CPU loads from the array. Call it before the load.
    pub fn load(&mut self, offset: u32, len: u32, array: &mut [u8], changed: &mut Vec<(u32, u32)>) {
        let last = (offset + len.max(1) - 1).min(array.len() as u32 - 1) / LINE;
        for offset in (offset / LINE..=last).map(|line| line * LINE) {
            let line = match self.lines.iter().position(|line| line.offset == offset) {
                Some(place) => self.lines.remove(place),
                None => {
                    if self.lines.len() == LINES {
                        let oldest = self.lines.remove(0).offset;
                        if let Some(bytes) = self.hidden.remove(&oldest) {
                            put(array, oldest, &bytes, changed);
                        }
                    }
                    Line { offset, bytes: bytes_at(array, offset) }
                }
            };
            self.lines.push(line);
        }
    }

    /// The array has its true bytes, for an operation or to be looked at.
    pub fn show_array(&mut self, array: &mut [u8], changed: &mut Vec<(u32, u32)>) {
        for (offset, bytes) in std::mem::take(&mut self.hidden) {
            put(array, offset, &bytes, changed);
        }
    }

    /// The operation is complete, in the array.
    pub fn note(&mut self, operation: &Operation) {
        let Operation::Program { offset, bytes } = operation else { return };
        if !self.is_enabled {
            return;
        }
        for (at, byte) in (*offset..).zip(bytes) {
            if let Some(line) = self.lines.iter_mut().find(|line| line.offset == at / LINE * LINE) {
                line.bytes[(at % LINE) as usize] = *byte;
            }
        }
    }

    /// The CPU sees the array through the cache again.
    pub fn show_lines(&mut self, array: &mut [u8], changed: &mut Vec<(u32, u32)>) {
        for line in self.lines.iter().filter(|_| self.is_enabled) {
            let bytes = bytes_at(array, line.offset);
            if bytes != line.bytes {
                self.hidden.insert(line.offset, bytes);
                put(array, line.offset, &line.bytes, changed);
            }
        }
    }

    /// The lines that the CPU sees and the array does not have.
    pub fn stale(&self) -> usize {
        self.hidden.len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: u32 = 0x400;

    /// A cache over an array of zeros.
    struct Model {
        cache: DataCache,
        array: Vec<u8>,
        changed: Vec<(u32, u32)>,
    }

    impl Model {
        fn new() -> Self {
            let mut model =
                Self { cache: DataCache::default(), array: vec![0; SIZE as usize], changed: Vec::new() };
            model.control(DCEN);
            model
        }

        fn control(&mut self, acr: u32) {
            self.cache.show_array(&mut self.array, &mut self.changed);
            self.cache.control(acr);
            self.cache.show_lines(&mut self.array, &mut self.changed);
        }

        fn load(&mut self, offset: u32) -> u8 {
            self.cache.load(offset, 1, &mut self.array, &mut self.changed);
            self.array[offset as usize]
        }

        fn complete(&mut self, operation: Operation) {
            self.cache.show_array(&mut self.array, &mut self.changed);
            match &operation {
                Operation::Program { offset, bytes } => {
                    for (cell, byte) in self.array[*offset as usize..].iter_mut().zip(bytes) {
                        *cell &= byte;
                    }
                }
                _ => self.array.fill(0xFF),
            }
            self.cache.note(&operation);
            self.cache.show_lines(&mut self.array, &mut self.changed);
        }

        fn erase(&mut self) {
            self.complete(Operation::Erase { sectors: Vec::new() });
        }
    }

    /// Section 3.6.4: an erase leaves what the cache has.
    #[test]
    fn a_line_that_was_read_is_stale_after_an_erase_until_the_cache_is_flushed() {
        let mut model = Model::new();
        assert_eq!(model.load(0x20), 0);
        model.erase();
        assert_eq!((model.load(0x2F), model.load(0x1F), model.load(0x30)), (0, 0xFF, 0xFF));
        assert_eq!(model.cache.stale(), 1);
        model.control(DCEN | DCRST);
        assert_eq!(model.load(0x20), 0, "DCRST counts only while the cache is disabled (FLASH_ACR)");
        model.control(0);
        assert_eq!(model.array[0x20], 0xFF, "without the cache the array is read");
        model.control(DCEN);
        assert_eq!(model.load(0x20), 0, "it was not flushed");
        for acr in [0, DCRST, DCEN] {
            model.control(acr);
        }
        assert_eq!((model.load(0x20), model.cache.stale()), (0xFF, 0));
    }

    /// Section 3.5.2: eight lines, and the least recently used one goes.
    #[test]
    fn the_ninth_line_takes_the_place_of_the_least_recently_used_one() {
        let mut model = Model::new();
        for line in 0..8 {
            model.load(line * LINE);
        }
        model.load(0);
        model.erase();
        model.load(8 * LINE);
        assert_eq!((model.load(0), model.array[LINE as usize]), (0, 0xFF));
        assert_eq!(model.cache.stale(), 7);
    }

    /// Section 3.6.4: programming changes the cache and the array. Where the cells cannot become 1, the two differ.
    #[test]
    fn programming_changes_the_cache_too() {
        let mut model = Model::new();
        model.erase();
        model.load(0);
        model.complete(Operation::Program { offset: 4, bytes: vec![0x5A] });
        assert_eq!((model.load(4), model.cache.stale()), (0x5A, 0));
        model.complete(Operation::Program { offset: 4, bytes: vec![0xA5] });
        assert_eq!((model.load(4), model.cache.stale()), (0xA5, 1));
        model.control(0);
        assert_eq!(model.array[4], 0x00);
        model.complete(Operation::Program { offset: 5, bytes: vec![0x11] });
        model.control(DCEN);
        assert_eq!(model.load(5), 0xFF, "it was programmed while the cache was disabled");
    }
}
