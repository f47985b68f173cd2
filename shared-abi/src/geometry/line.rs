//! The lines of the family, and the properties that all chips of a line share.

/// A line of the STM32F4 family with CAN controllers of the type bxCAN. (STM32F401, F410 and F411
/// have none.)
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
#[allow(missing_docs)]
pub enum Line {
    F405,
    F407,
    F412,
    F413,
    F415,
    F417,
    F423,
    F427,
    F429,
    F437,
    F439,
    F446,
    F469,
    F479,
}

/// The highest clocks of a chip at a supply voltage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// The core's clock in Hz. Over-drive is off: this firmware does not use it.
    pub sysclk: u32,
    /// The core's clock in Hz with the regulator's scale after a reset (`PWR_CR.VOS`). For a faster
    /// clock the scale must be raised first.
    pub sysclk_after_reset: u32,
    /// Clock of APB1 in Hz.
    pub apb1: u32,
    /// Clock of APB2 in Hz.
    pub apb2: u32,
    /// Each wait state of the flash allows this many Hz more. Up to this clock no wait state is
    /// needed.
    pub per_wait_state: u32,
}

impl Line {
    /// All lines.
    pub const ALL: [Self; 14] = [
        Self::F405,
        Self::F407,
        Self::F412,
        Self::F413,
        Self::F415,
        Self::F417,
        Self::F423,
        Self::F427,
        Self::F429,
        Self::F437,
        Self::F439,
        Self::F446,
        Self::F469,
        Self::F479,
    ];

    /// The line's name, as the HAL's features and the chips' names begin: `stm32f407`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::F405 => "stm32f405",
            Self::F407 => "stm32f407",
            Self::F412 => "stm32f412",
            Self::F413 => "stm32f413",
            Self::F415 => "stm32f415",
            Self::F417 => "stm32f417",
            Self::F423 => "stm32f423",
            Self::F427 => "stm32f427",
            Self::F429 => "stm32f429",
            Self::F437 => "stm32f437",
            Self::F439 => "stm32f439",
            Self::F446 => "stm32f446",
            Self::F469 => "stm32f469",
            Self::F479 => "stm32f479",
        }
    }

    /// The line of a chip, from the first nine letters of its name in any case.
    #[must_use]
    pub fn of(chip: &str) -> Option<Self> {
        let line = chip.get(..9)?;
        Self::ALL.into_iter().find(|known| known.name().eq_ignore_ascii_case(line))
    }

    /// Size in bytes of the SRAM for both the CPU and the bus masters, from 2000_0000h on.
    ///
    /// Memory maps of RM0090 (SRAM1, SRAM2 and SRAM3 follow one another), RM0402, RM0430, RM0390
    /// and RM0386.
    #[must_use]
    pub const fn sram(self) -> u32 {
        const KIB: u32 = 1024;
        match self {
            Self::F405 | Self::F407 | Self::F415 | Self::F417 | Self::F446 => (112 + 16) * KIB,
            Self::F427 | Self::F429 | Self::F437 | Self::F439 => (112 + 16 + 64) * KIB,
            Self::F412 => 256 * KIB,
            Self::F413 | Self::F423 => (256 + 64) * KIB,
            Self::F469 | Self::F479 => (160 + 32 + 128) * KIB,
        }
    }

    /// Size in bytes of the core-coupled RAM at 1000_0000h, from the same memory maps; 0 for none.
    #[must_use]
    pub const fn ccm(self) -> u32 {
        match self {
            Self::F412 | Self::F413 | Self::F423 | Self::F446 => 0,
            _ => 64 * 1024,
        }
    }

    /// Number of interrupt lines after the 16 exceptions of the core: the vector tables of RM0090
    /// (tables 61 and 62), RM0402, RM0430, RM0390 and RM0386.
    #[must_use]
    pub const fn interrupts(self) -> u16 {
        match self {
            Self::F405 | Self::F407 | Self::F415 | Self::F417 => 82,
            Self::F427 | Self::F429 | Self::F437 | Self::F439 => 91,
            Self::F412 | Self::F446 => 97,
            Self::F413 | Self::F423 => 102,
            Self::F469 | Self::F479 => 93,
        }
    }

    /// Number of interrupt lines with vectors in the PAC: it lacks the last four of the STM32F427
    /// and F437 (SAI1 and DMA2D, two are reserved).
    #[must_use]
    pub const fn pac_interrupts(self) -> u16 {
        match self {
            Self::F427 | Self::F437 => self.interrupts() - 4,
            _ => self.interrupts(),
        }
    }

    /// Number of GPIO ports, from A on (tables of register boundary addresses). Packages have
    /// fewer.
    #[must_use]
    pub const fn ports(self) -> u8 {
        match self {
            Self::F405 | Self::F407 | Self::F415 | Self::F417 => 9,
            Self::F412 | Self::F413 | Self::F423 | Self::F446 => 8,
            _ => 11,
        }
    }

    /// Number of CAN controllers. The third one of three (a pair of its own beside CAN1 and CAN2)
    /// is not supported here.
    #[must_use]
    pub const fn can_controllers(self) -> u8 {
        match self {
            Self::F413 | Self::F423 => 3,
            _ => 2,
        }
    }

    /// The highest clocks at 2.7 to 3.6 V.
    #[must_use]
    pub const fn limits(self) -> Limits {
        self.limits_at(3_300)
    }

    /// The highest clocks at a supply of `supply_mv` mV, 1800 to 3600.
    ///
    /// "General operating conditions" of the datasheets DS8626 and DS8597 (F405 to F417, table 14),
    /// DS11139 (F412), DS11581 and DS11582 (F413, F423), DS9405 and DS9484 (F42x, F43x), DS10693
    /// (F446), DS11189 and DS11118 (F469, F479); wait states: "Relation between CPU clock frequency
    /// and flash memory read time" of the reference manuals. With over-drive, the chips from F427 on
    /// reach 180, 45 and 90 MHz.
    #[must_use]
    pub const fn limits_at(self, supply_mv: u32) -> Limits {
        const MHZ: u32 = 1_000_000;
        let per_wait_state = self.mhz_per_wait_state(supply_mv) * MHZ;
        let fast = Limits {
            // With their seven wait states, F405 to F417 do not reach 168 MHz below 2.1 V.
            sysclk: match self {
                Self::F405 | Self::F407 | Self::F415 | Self::F417 if supply_mv < 2_100 => 160 * MHZ,
                _ => 168 * MHZ,
            },
            sysclk_after_reset: 168 * MHZ,
            apb1: 42 * MHZ,
            apb2: 84 * MHZ,
            per_wait_state,
        };
        // After a reset their regulator is at scale 2 (RM0402 and RM0430, PWR_CR).
        let slow = Limits {
            sysclk: 100 * MHZ,
            sysclk_after_reset: 84 * MHZ,
            apb1: 50 * MHZ,
            apb2: 100 * MHZ,
            per_wait_state,
        };
        match self {
            Self::F412 | Self::F413 | Self::F423 => slow,
            _ => fast,
        }
    }

    /// By how many MHz a wait state of the flash raises the core's clock at this supply: "Number of wait
    /// states according to CPU clock frequency" (RM0090 tables 11 and 12, RM0402, RM0430, RM0390, RM0386).
    const fn mhz_per_wait_state(self, supply_mv: u32) -> u32 {
        let [from_2700, from_2400, from_2100, below] = match self {
            Self::F412 => [30, 24, 18, 16],
            Self::F413 | Self::F423 => [25, 20, 18, 16],
            _ => [30, 24, 22, 20],
        };
        match supply_mv {
            2_700.. => from_2700,
            2_400.. => from_2400,
            2_100.. => from_2100,
            _ => below,
        }
    }
}
