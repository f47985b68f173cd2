//! The bit timing of bxCAN: bootloader and application sample a bit at the same point.

/// A bit timing that bxCAN can be set to (RM0090 section 32.7.7).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BitTiming {
    /// Time quanta are this many clock cycles, 1–1024.
    pub prescaler: u16,
    /// Quanta from the sync segment to the sample point, 1–16.
    pub segment_1: u8,
    /// Quanta from the sample point to the end of the bit, 1–8.
    pub segment_2: u8,
}

impl BitTiming {
    /// The timing that makes `bit_rate` (bit/s) out of `clock` (Hz) exactly, with the sample point
    /// as near to 87.5 % as it gets (the point that CiA 301 recommends) and as many quanta as fit;
    /// `None` where the clock cannot make it.
    #[must_use]
    pub const fn new(clock: u32, bit_rate: u32) -> Option<Self> {
        if bit_rate == 0 || clock < bit_rate || !clock.is_multiple_of(bit_rate) {
            return None;
        }
        let cycles = clock / bit_rate;
        let mut quanta = 25;
        while quanta >= 8 {
            if cycles.is_multiple_of(quanta) && cycles / quanta <= 1024 {
                // 1 quantum of sync, then the segments; 1/8 of the bit, rounded, after the sample
                // point.
                let segment_2 = (quanta + 4) / 8;
                let segment_1 = quanta - 1 - segment_2;
                if segment_1 <= 16 {
                    return Some(Self {
                        prescaler: (cycles / quanta) as u16,
                        segment_1: segment_1 as u8,
                        segment_2: segment_2 as u8,
                    });
                }
            }
            quanta -= 1;
        }
        None
    }

    /// The timings of several bit rates, worked out at compile time.
    #[must_use]
    pub const fn table<const N: usize>(clock: u32, bit_rates: [u32; N]) -> [Option<Self>; N] {
        let mut table = [None; N];
        let mut i = 0;
        while i < N {
            table[i] = Self::new(clock, bit_rates[i]);
            i += 1;
        }
        table
    }

    /// The value of `CAN_BTR`; resynchronisation by up to 1 quantum.
    #[must_use]
    pub const fn register(&self) -> u32 {
        (self.prescaler as u32 - 1) | (self.segment_1 as u32 - 1) << 16 | (self.segment_2 as u32 - 1) << 20
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// CiA 301 table 1 recommends 87.5 %. (14 quanta, all that 42 MHz has for 1 Mbit/s, come to 85.7 %.)
    #[test]
    fn every_bit_rate_of_canopen_is_exact_and_sampled_late() {
        for (clock, without) in [(40_000_000, 0), (42_000_000, 800_000), (36_000_000, 0)] {
            for bit_rate in [10_000, 20_000, 50_000, 125_000, 250_000, 500_000, 800_000, 1_000_000] {
                let Some(timing) = BitTiming::new(clock, bit_rate) else {
                    assert_eq!(bit_rate, without, "{clock} Hz");
                    continue;
                };
                let quanta = 1 + u32::from(timing.segment_1) + u32::from(timing.segment_2);
                assert_eq!(u32::from(timing.prescaler) * quanta * bit_rate, clock, "{timing:?}");
                let sample_point = (1 + u32::from(timing.segment_1)) * 1000 / quanta;
                assert!((830..=900).contains(&sample_point), "{bit_rate} of {clock}: {timing:?}");
                // Widths of the fields (RM0090 section 32.9.2, CAN_BTR).
                assert!(timing.prescaler <= 1024 && timing.segment_1 <= 16 && timing.segment_2 <= 8);
            }
        }
        assert_eq!(BitTiming::new(42_000_000, 0), None);
        assert_eq!(BitTiming::new(0, 125_000), None);
        assert_eq!(BitTiming::new(42_000_000, u32::MAX), None);
    }

    /// 42 MHz / (6 * 14) is 500 kbit/s; 800 kbit/s would be 52.5 cycles.
    #[test]
    fn a_table_has_each_bit_rate_in_its_place() {
        let table = BitTiming::table(42_000_000, [800_000, 500_000]);
        assert_eq!(table, [None, BitTiming::new(42_000_000, 500_000)]);
        assert!(table[1].is_some());
    }

    /// RM0090 section 32.9.2: BRP, TS1 and TS2 each hold one less; SJW 0 is one quantum.
    #[test]
    fn the_register_is_that_of_the_manual() {
        let timing = BitTiming { prescaler: 3, segment_1: 11, segment_2: 2 };
        assert_eq!(timing.register(), 0x001A_0002);
    }
}
