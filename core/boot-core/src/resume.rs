//! What a device keeps of a download of block files, so that it can go on after a cut.

/// How often the progress of a download is stored, at most.
const NOTES: u32 = 16;
/// The fewest bytes after which it is stored.
const STEP: u32 = 1024;

/// The progress of a download of block files.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Partial {
    /// The CRC of its control block, 0 if it cannot go on.
    id: u32,
    /// The address up to which its data are in flash.
    end: u32,
    /// It went on after a cut: its data may already be in flash.
    resumed: bool,
}

impl Partial {
    /// No download.
    pub const NONE: Self = Self::of_words([0; 2]);

    /// A download that begins at `base`, with the CRC of its control block; 0 for one that cannot go
    /// on after a cut.
    #[must_use]
    pub const fn begin(id: u32, base: u32) -> Self {
        Self { id, end: base, resumed: false }
    }

    /// From its stored form.
    #[must_use]
    pub const fn of_words([id, end]: [u32; 2]) -> Self {
        Self { id, end, resumed: true }
    }

    /// The same for a device on which no download goes on after a cut.
    #[must_use]
    pub(crate) const fn forbidden(self) -> Self {
        Self { id: 0, ..self }
    }

    /// The stored form: the CRC of its control block, and the address up to which its data are in
    /// flash.
    #[must_use]
    pub const fn words(self) -> [u32; 2] {
        [self.id, self.end]
    }

    /// Whether it is a download of the same block file.
    pub(crate) const fn is_same(self, other: Self) -> bool {
        self.id != 0 && self.id == other.id
    }

    /// It does not go on after a cut any more. Returns whether it could.
    pub(crate) const fn forbid(&mut self) -> bool {
        core::mem::replace(&mut self.id, 0) != 0
    }

    /// Whether it goes on after a cut.
    pub(crate) const fn is_resumed(self) -> bool {
        self.resumed
    }

    /// The address of its first data that are not in flash.
    pub(crate) const fn start(self) -> u32 {
        self.end
    }

    /// Takes note of data in flash up to `end`, of a program with `size` bytes. Returns whether the
    /// progress must be stored.
    pub(crate) const fn note(&mut self, end: u32, size: u32) -> bool {
        let step = if size > NOTES * STEP { size / NOTES } else { STEP };
        let is_far = self.id != 0 && end.wrapping_sub(self.end) as i32 >= step as i32;
        if is_far {
            self.end = end;
        }
        is_far
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each KiB of a short program, a sixteenth of a long one: the journal has room for so many.
    #[test]
    fn progress_is_noted_sixteen_times_and_not_more_often_than_each_kib() {
        let base = 0x0800_4000;
        for (size, step) in [
            (0, 1024),
            (1000, 1024),
            (8000, 1024),
            (16 * 1024, 1024),
            (32 * 1024, 2048),
            (1024 * 1024, 64 * 1024),
        ] {
            let mut partial = Partial::begin(3, base);
            assert!(!partial.note(base + step - 1, size), "{size}");
            assert_eq!(partial.words(), [3, base]);
            assert!(partial.note(base + step, size), "{size}");
            assert!(!partial.note(base + step, size) && !partial.note(base, size), "{size}");
            assert_eq!(partial.words(), [3, base + step]);
        }
        let mut other = Partial::begin(0, base);
        assert!(!other.note(base + 0x10_0000, 0), "it cannot go on");
    }
}
