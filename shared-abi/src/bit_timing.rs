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
    /// as near to 87.5 % as it gets (the point that CiA 301 recommends), and of those the one with the most
    /// quanta; `None` where the clock cannot make it.
    #[must_use]
    pub const fn new(clock: u32, bit_rate: u32) -> Option<Self> {
        if bit_rate == 0 || clock < bit_rate || !clock.is_multiple_of(bit_rate) {
            return None;
        }
        let cycles = clock / bit_rate;
        let mut best: Option<Self> = None;
        let mut quanta = 25;
        while quanta >= 8 {
            if cycles.is_multiple_of(quanta) && cycles / quanta <= 1024 {
                // 1 quantum of sync, then the segments; 1/8 of the bit, rounded, after the sample
                // point.
                let segment_2 = (quanta + 4) / 8;
                let timing = Self {
                    prescaler: (cycles / quanta) as u16,
                    segment_1: (quanta - 1 - segment_2) as u8,
                    segment_2: segment_2 as u8,
                };
                let is_better = match best {
                    Some(best) => timing.distance() * best.quanta() < best.distance() * quanta,
                    None => true,
                };
                if timing.segment_1 <= 16 && is_better {
                    best = Some(timing);
                }
            }
            quanta -= 1;
        }
        best
    }

    /// The quanta of a bit.
    const fn quanta(&self) -> u32 {
        1 + self.segment_1 as u32 + self.segment_2 as u32
    }

    /// How far the sample point is from 87.5 % of the bit, in eighths of a quantum.
    const fn distance(&self) -> u32 {
        self.quanta().abs_diff(8 * self.segment_2 as u32)
    }

    /// By how many quanta an edge may move the sample point: the most that bxCAN and segment 2 allow. With
    /// one quantum alone, the clocks of two nodes may differ by 0.3 % to 0.6 % (ISO 11898-1).
    const fn jump(&self) -> u32 {
        if self.segment_2 < 4 {
            self.segment_2 as u32
        } else {
            4
        }
    }

    /// The [registers](Self::register) of several bit rates, worked out at compile time; 0, which is that of
    /// no timing, where the clock cannot make one.
    #[must_use]
    pub const fn registers<const N: usize>(clock: u32, bit_rates: [u32; N]) -> [u32; N] {
        let mut registers = [0; N];
        let mut i = 0;
        while i < N {
            if let Some(timing) = Self::new(clock, bit_rates[i]) {
                registers[i] = timing.register();
            }
            i += 1;
        }
        registers
    }

    /// The value of `CAN_BTR`.
    #[must_use]
    pub const fn register(&self) -> u32 {
        (self.prescaler as u32 - 1)
            | (self.segment_1 as u32 - 1) << 16
            | (self.segment_2 as u32 - 1) << 20
            | (self.jump() - 1) << 24
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// CiA 301 table 1 recommends 87.5 %. Each clock makes it where 8, 16 or 24 quanta divide the cycles of a
    /// bit; for the others, all divisors from 8 to 25 were tried on paper.
    #[test]
    fn every_bit_rate_of_canopen_is_exact_and_sampled_as_near_to_87_5_as_it_gets() {
        // Clock, bit rate: the sample point in per mille; for 800 kbit/s, 42 MHz would be 52.5 cycles.
        let others = [
            // 50 cycles, 10 quanta: with 25, segment 1 would be too long.
            (40_000_000, 800_000, Some(900)),
            // 2100 cycles, 15 quanta.
            (42_000_000, 20_000, Some(866)),
            // 84 and 42 cycles, 21 quanta.
            (42_000_000, 500_000, Some(857)),
            (42_000_000, 1_000_000, Some(857)),
            (42_000_000, 800_000, None),
            // 45 cycles, 15 quanta; 36 cycles, 18 quanta.
            (36_000_000, 800_000, Some(866)),
            (36_000_000, 1_000_000, Some(888)),
        ];
        for clock in [40_000_000, 42_000_000, 36_000_000] {
            for bit_rate in [10_000, 20_000, 50_000, 125_000, 250_000, 500_000, 800_000, 1_000_000] {
                let other = others.iter().find(|(of, rate, _)| (*of, *rate) == (clock, bit_rate));
                let sample_point = other.map_or(Some(875), |(.., sample_point)| *sample_point);
                let timing = BitTiming::new(clock, bit_rate);
                let found = timing.map(|timing| (1 + u32::from(timing.segment_1)) * 1000 / timing.quanta());
                assert_eq!(found, sample_point, "{bit_rate} of {clock}: {timing:?}");
                let Some(timing) = timing else { continue };
                assert_eq!(u32::from(timing.prescaler) * timing.quanta() * bit_rate, clock, "{timing:?}");
                // Widths of the fields (RM0090 section 32.9.2, CAN_BTR).
                assert!(timing.prescaler <= 1024 && timing.segment_1 <= 16 && timing.segment_2 <= 8);
            }
        }
        assert_eq!(BitTiming::new(42_000_000, 0), None);
        assert_eq!(BitTiming::new(0, 125_000), None);
        assert_eq!(BitTiming::new(42_000_000, u32::MAX), None);
    }

    /// 42 MHz / (6 * 14) is 500 kbit/s, with 11 quanta before the sample point and 2 after it (BRP 5, TS1 10,
    /// TS2 1, SJW 1); 800 kbit/s would be 52.5 cycles.
    #[test]
    fn a_table_has_each_bit_rate_in_its_place() {
        assert_eq!(BitTiming::registers(42_000_000, [800_000, 500_000]), [0, 0x011A_0005]);
    }

    /// RM0090 section 32.9.2: BRP, TS1, TS2 and SJW each hold one less. SJW is at most four quanta, and at
    /// most segment 2 (ISO 11898-1).
    #[test]
    fn the_register_is_that_of_the_manual() {
        let timing = BitTiming { prescaler: 3, segment_1: 11, segment_2: 2 };
        assert_eq!(timing.register(), 0x011A_0002);
        let timing = BitTiming { prescaler: 1, segment_1: 13, segment_2: 1 };
        assert_eq!(timing.register(), 0x000C_0000);
        let timing = BitTiming { prescaler: 1024, segment_1: 16, segment_2: 8 };
        assert_eq!(timing.register(), 0x037F_03FF);
    }
}
