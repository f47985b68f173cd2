//! The programs of the machine's tests: `programs/NAME.s`, assembled when a test first asks for one.

use std::sync::LazyLock;

use crate::assembler::assemble;

/// A program: its code, where that lies, and the exception handlers by exception number.
pub struct Program {
    /// Address of the first instruction, which is the entry point of a program in flash.
    pub base: u32,
    /// (exception number, vector).
    pub vectors: Vec<(usize, u32)>,
    /// Machine code.
    pub code: Vec<u8>,
}

impl Program {
    fn assembled(name: &str) -> Self {
        const FLASH: u32 = 0x0800_0200;
        const PLACE: &str = "sim/emulator/tests/it/machine/programs";
        let assembled = assemble(&format!("{PLACE}/{}.s", name.to_lowercase()), FLASH);
        let words = assembled.vectors.chunks_exact(4);
        let words: Vec<_> = words.map(|word| u32::from_le_bytes(word.try_into().unwrap())).collect();
        Self {
            base: assembled.symbol("BASE").unwrap_or(FLASH),
            vectors: words.chunks_exact(2).map(|pair| (pair[0] as usize, pair[1])).collect(),
            code: assembled.code,
        }
    }
}

macro_rules! programs {
    ($($name:ident,)*) => {
        $(pub static $name: LazyLock<Program> = LazyLock::new(|| Program::assembled(stringify!($name)));)*
    };
}

programs! {
    STORES_AND_SLEEPS,
    POLLS_THE_FLASH,
    COUNTS_THE_POLLS,
    SYSTICK,
    NESTING,
    MASKS,
    PROCESS_STACK,
    FPU,
    FAULTS,
    RESET,
    WATCHDOG,
    FLASH_FROM_FLASH,
    FLASH_FROM_RAM,
    TO_RAM,
    BIT_BAND,
    PERIPHERALS,
    BUSY,
    VECTORS_IN_RAM,
    EVENTS,
    SLEEPS_ON_EXIT,
    WRITES_ITS_OWN_CODE,
    UNPRIVILEGED,
    FAULTMASK,
    STORES_OF_A_SCRIPT,
    ERASE_UNDER_INTERRUPTS,
    SCALES_THE_CLOCK,
    CONDITIONS,
    CONDITIONAL_LOADS,
    CALLS_WHAT_IT_HAS_READ,
    BREAKPOINTS,
    TIMER_HALVES,
    TIMER_PERIOD,
    WRITES_AND_WAITS,
    BUTTON,
    STANDBY,
    SLEEPS_WITH_A_TIMER,
    TIME_IN_A_BLOCK,
    COUNTS_DOWN,
    LOADS_BY_THE_CACHE,
    RUNS_BY_THE_CACHE,
    LOADS_HIDDEN_CODE,
    STORES_TO_OTP,
    OVER_DRIVE,
    RTC,
}
