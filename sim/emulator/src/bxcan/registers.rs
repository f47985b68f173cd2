//! The bits of the registers (RM0090 section 32.9).

/// CAN_MCR.
pub mod mcr {
    pub const INRQ: u32 = 1 << 0;
    pub const SLEEP: u32 = 1 << 1;
    pub const TXFP: u32 = 1 << 2;
    pub const RFLM: u32 = 1 << 3;
    pub const NART: u32 = 1 << 4;
    pub const AWUM: u32 = 1 << 5;
    pub const ABOM: u32 = 1 << 6;
    pub const TTCM: u32 = 1 << 7;
    pub const RESET: u32 = 1 << 15;
    pub const DBF: u32 = 1 << 16;
    pub const AFTER_RESET: u32 = DBF | SLEEP;
    pub const KEPT: u32 = INRQ | SLEEP | TXFP | RFLM | NART | AWUM | ABOM | TTCM | DBF;
}

/// CAN_MSR.
pub mod msr {
    pub const INAK: u32 = 1 << 0;
    pub const SLAK: u32 = 1 << 1;
    pub const ERRI: u32 = 1 << 2;
    pub const WKUI: u32 = 1 << 3;
    pub const SLAKI: u32 = 1 << 4;
    pub const TXM: u32 = 1 << 8;
    pub const RXM: u32 = 1 << 9;
    pub const SAMP: u32 = 1 << 10;
    pub const RX: u32 = 1 << 11;
}

/// One byte of CAN_TSR: the flags of one mailbox.
pub mod tsr {
    pub const RQCP: u32 = 1 << 0;
    pub const TXOK: u32 = 1 << 1;
    pub const ALST: u32 = 1 << 2;
    pub const TERR: u32 = 1 << 3;
    pub const ABRQ: u32 = 1 << 7;
}

/// CAN_RFxR.
pub mod rfr {
    pub const FULL: u32 = 1 << 3;
    pub const FOVR: u32 = 1 << 4;
    pub const RFOM: u32 = 1 << 5;
}

/// CAN_IER.
pub mod ier {
    pub const TMEIE: u32 = 1 << 0;
    /// FMPIE0; FIFO 1 has the same three bits, three places higher.
    pub const FMPIE: u32 = 1 << 1;
    pub const FFIE: u32 = 1 << 2;
    pub const FOVIE: u32 = 1 << 3;
    pub const EWGIE: u32 = 1 << 8;
    pub const EPVIE: u32 = 1 << 9;
    pub const BOFIE: u32 = 1 << 10;
    pub const LECIE: u32 = 1 << 11;
    pub const ERRIE: u32 = 1 << 15;
    pub const WKUIE: u32 = 1 << 16;
    pub const SLKIE: u32 = 1 << 17;
    pub const ALL: u32 = 0x0003_8F7F;
}

/// CAN_ESR.
pub mod esr {
    pub const EWGF: u32 = 1 << 0;
    pub const EPVF: u32 = 1 << 1;
    pub const BOFF: u32 = 1 << 2;
    pub const LEC_SHIFT: u32 = 4;
}

/// CAN_BTR.
pub mod btr {
    pub const LBKM: u32 = 1 << 30;
    pub const SILM: u32 = 1 << 31;
    pub const ALL: u32 = LBKM | SILM | 3 << 24 | 7 << 20 | 15 << 16 | 0x3FF;
    pub const AFTER_RESET: u32 = 0x0123_0000;
}

/// CAN_TIxR and CAN_RIxR.
pub mod ir {
    pub const TXRQ: u32 = 1 << 0;
    pub const RTR: u32 = 1 << 1;
    pub const IDE: u32 = 1 << 2;
}
