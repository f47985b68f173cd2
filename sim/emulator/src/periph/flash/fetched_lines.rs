//! The instruction cache of the flash interface: 64 lines of 128 bits, the least recently used one is
//! replaced (RM0090 section 3.5.2).
//!
//! An erase leaves what the cache has: software has to flush it before code of the sector runs, and that
//! works only while the cache is disabled (section 3.6.4, programming and caches). The manual does not say
//! what programming does to this cache; here it leaves the lines, too.
//!
//! This module knows which lines are old, and not what they hold: a program that fetches one is wrong even
//! if the old code happens to do no harm.

/// Bytes of a line.
const LINE: u32 = 16;
/// How many there are.
const LINES: usize = 64;

/// FLASH_ACR.
const ICEN: u32 = 1 << 9;
const ICRST: u32 = 1 << 11;

struct Line {
    offset: u32,
    /// The array has changed since the line was read.
    is_old: bool,
}

/// The lines that the cache has.
#[derive(Default)]
pub struct FetchedLines {
    is_enabled: bool,
    /// The least recently used one first.
    lines: Vec<Line>,
}

impl FetchedLines {
    /// Whether fetches come by the cache.
    pub fn is_enabled(&self) -> bool {
        self.is_enabled
    }

    /// FLASH_ACR is written.
    pub fn control(&mut self, acr: u32) {
        self.is_enabled = acr & ICEN != 0;
        if !self.is_enabled && acr & ICRST != 0 {
            self.lines.clear();
        }
    }

    /// The CPU fetches code from the array. Returns the offset of the first line of it that is old.
    pub fn fetch(&mut self, offset: u32, len: u32) -> Option<u32> {
        let last = (offset + len.max(1) - 1) / LINE;
        let mut old = None;
        for offset in (offset / LINE..=last).map(|line| line * LINE) {
            let line = match self.lines.iter().rposition(|line| line.offset == offset) {
                Some(place) => self.lines.remove(place),
                None => {
                    if self.lines.len() == LINES {
                        self.lines.remove(0);
                    }
                    Line { offset, is_old: false }
                }
            };
            old = old.or(line.is_old.then_some(offset));
            self.lines.push(line);
        }
        old
    }

    /// An operation has changed this range of the array.
    pub fn note(&mut self, offset: u32, len: u32) {
        for line in &mut self.lines {
            line.is_old |= line.offset < offset + len && offset < line.offset + LINE;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn enabled() -> FetchedLines {
        let mut lines = FetchedLines::default();
        lines.control(ICEN);
        lines
    }

    /// Section 3.6.4: an erase leaves what the cache has.
    #[test]
    fn a_line_that_was_fetched_is_old_after_a_change_until_the_cache_is_flushed() {
        let mut lines = enabled();
        assert_eq!(lines.fetch(0x2C, 8), None);
        lines.note(0x30, 0x10);
        assert_eq!((lines.fetch(0x2E, 2), lines.fetch(0x40, 2)), (None, None));
        assert_eq!((lines.fetch(0x2E, 4), lines.fetch(0x3E, 2)), (Some(0x30), Some(0x30)));
        lines.control(ICEN | ICRST);
        assert_eq!(
            lines.fetch(0x30, 2),
            Some(0x30),
            "ICRST counts only while the cache is disabled (FLASH_ACR)"
        );
        for acr in [0, ICEN] {
            lines.control(acr);
        }
        assert_eq!(lines.fetch(0x30, 2), Some(0x30), "it was not flushed");
        for acr in [0, ICRST, ICEN] {
            lines.control(acr);
        }
        assert_eq!(lines.fetch(0x30, 2), None);
    }

    /// Section 3.5.2: 64 lines, and the least recently used one goes.
    #[test]
    fn the_line_after_the_sixty_fourth_takes_the_place_of_the_least_recently_used_one() {
        let mut lines = enabled();
        for line in 0..64 {
            lines.fetch(line * LINE, 2);
        }
        lines.fetch(0, 2);
        lines.note(0, 0x400);
        lines.fetch(0x400, 2);
        assert_eq!((lines.fetch(LINE, 2), lines.fetch(0, 2)), (None, Some(0)));
    }
}
