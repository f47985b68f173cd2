// The table of all choices of a product, in groups: each with its meaning, its type, its default, and the
// other values that `cargo xtask pairs` and the tests try. Who includes this file has a macro `choices!`,
// which makes of it the struct `Product` (product.rs), the rows of docs/product.md (`cargo xtask pairs
// --page`), the products of `pairs`, or those of tests/update/choices.rs. Names in brackets are those of the
// SYS TEC manual (L-1112d_10, chapter 4.8).

choices! {
    /// The dialect, where dialects contradict each other ([dialects](dialects.md)).
    profile: Profile = Profile::STANDARD => [Profile::PAULUS, Profile::ESACADEMY, Profile::LIFT];

    /// The programs that start by themselves after a reset (`BLCOP_USE_AUTOSTART_APP`); `None` for a
    /// device that waits for START.
    autostart: Option<Start> = Some(Start::DEFAULT) => [None],
    #[derive(Copy)]
    struct Start {
        /// The programs, the preferred one first: the device starts the first one that is valid,
        /// released and allowed. `InOrder` is each program, the lowest number first; a list,
        /// `Autostart::List(&[2, 1])`; or `Autostart::Function`, which returns such a list, from a
        /// switch for instance, under the conditions of `hooks.start_allowed`. Programs count from
        /// 1, as sub-indices do: index 0 of the manual (`BLCOP_APP_START_INDEX`) is program 1.
        programs: Autostart = Autostart::InOrder => [Autostart::Function(|| &[1])];
        /// The number of crashes in a row after which the device stays in the bootloader, 1 to 255.
        max_crash_resets: u32 = 3 => [1];
        /// Whether a reset by the NRST pin counts as one by the watchdog does: for a board with a
        /// [watchdog chip](porting.md#a-watchdog-chip), which resets by that pin. A reset button and a
        /// debug probe then count, too; a power-on begins a new count, as ever.
        pin_resets_are_crashes: bool = false => [true];
        /// How long the bootloader listens before it starts a program that was never confirmed, in
        /// ms, less than the period of the heartbeat; 0 for not at all. An SDO request to the node or
        /// any layer setting service in this time keeps the device in the bootloader.
        rescue_window_ms: u16 = 300 => [0];
        /// The same for a confirmed program.
        rescue_window_confirmed_ms: u16 = 0 => [100];
    };

    /// Node-ID and bit rate.
    node: Node = Node::DEFAULT => [],
    struct Node {
        /// Where they come from (`TgtGetNodeId`): `Stored`, as layer setting services left them, and
        /// until then those of the board or of the profile; `Constant`, these alone; or a `Function`,
        /// for [switches](#node-id-and-bit-rate-by-switches).
        source: NodeSource = NodeSource::Stored => [NodeSource::Constant, NodeSource::Function(|| {
            let switches = bsp::inputs('E');
            ((switches >> 8) as u8 & 0x7F, (switches >> 4) as u8 & 0xF)
        })];
        /// The node-IDs that the device takes by LSS and the callgate (`BLCOP_MIN_NODEID`,
        /// `BLCOP_MAX_NODEID`); with another one no program starts. That of the board, or of the
        /// profile, must be among them.
        ids: RangeInclusive<u8> = 1..=127 => [1..=100];
        /// The bit rates that the device may be set to, as indices of CiA 305 table 1: 0 for 1 Mbit/s
        /// to 8 for 10 kbit/s (`BLCOP_MIN_BAUIDX`, `BLCOP_MAX_BAUIDX`). That of the board, or of the
        /// profile, must be among them.
        bit_rates: RangeInclusive<u8> = 0..=8 => [2..=6];
        /// Whether the bit rate may be found by listening, if none is stored or set; the compact map
        /// has no room for it.
        auto_bit_rate: bool = SPLIT => [false];
    };

    /// Whose product the device is.
    identity: Identity = Identity::DEFAULT => [],
    #[derive(Copy)]
    struct Identity {
        /// Where vendor-ID, product code, revision and serial number (1018h) come from
        /// (`BLCOP_IDENTITY_VENDORID`, `BLCOP_IDENTITY_PRODUCTID`, `BLCOP_IDENTITY_REVISION`,
        /// `BLCOP_IDENTITY_SERIALNR`): the board file, or the nameplate of an
        /// [OEM](#the-identity-of-an-oem) in the chip (`Otp`).
        source: IdentitySource = IdentitySource::Board
            => [if SPLIT { IdentitySource::Otp } else { IdentitySource::Board }];
        /// Whether vendor-ID and product code of a program must be those of the device
        /// (`BLCOP_IDENTITY_CHECK`).
        check: bool = true => [false];
    };

    /// The independent watchdog.
    watchdog: Watchdog = Watchdog::DEFAULT => [],
    #[derive(Copy)]
    struct Watchdog {
        /// The longest time without a check-in of a task of the bootloader, in ms, 250 to 4000; it runs
        /// while a crystal that does not start is waited for. `None` for no watchdog
        /// (`BLCOP_USE_WATCHDOG`).
        bootloader_ms: Option<u16> = Some(1000) => [None];
        /// The time within which a program must feed it, from its first instruction on, in ms, 1 to
        /// 4000, by the LSI (1000 are 0.7 to 1.9 s); `None` to start programs without it.
        program_ms: Option<u16> = None => [Some(1000)];
    };

    /// Layer setting services (LSS, CiA 305); `None` for none, as on the compact map in the profiles
    /// with a password (`ESACADEMY`, `LIFT`), which bring a node-ID of their own.
    lss: Option<Lss> = Some(Lss::DEFAULT) => [None],
    #[derive(Copy)]
    struct Lss {
        /// Whether the device starts in configuration state, for a bus with one device to configure.
        start_in_configuration: bool = false => [true];
        /// Whether a device without node-ID announces itself ("non-configured slave").
        announce: bool = false => [true];
        /// Whether masters find the device by ranges of its address (identify remote slave, 46h to
        /// 4Bh), besides fastscan; the compact map has no room for it.
        identify: bool = SPLIT => [false];
        /// Whether LSS may store node-ID and bit rate.
        store: bool = true => [false];
        /// What the device does when its crystal fails, and the clock of its CAN controller may be
        /// wrong: it listens until a request of LSS arrives without an error (`Silent`), or it takes
        /// part at once (`RunFromHsi`), as a device without LSS does ([protocol](protocol.md#emcy)).
        crystal_failure: CrystalFailure = CrystalFailure::Silent => [CrystalFailure::RunFromHsi];
    };

    /// What the device sends of itself, and when it leaves.
    nmt: Nmt = Nmt::DEFAULT => [],
    #[derive(Copy)]
    struct Nmt {
        /// Whether the node sends a boot-up message (`BLCOP_SEND_BOOTUP`).
        boot_up_message: bool = true => [false];
        /// Whether an emergency follows the boot-up: it shows a master that the bootloader runs, and not
        /// the application.
        boot_up_emergency: bool = true => [false];
        /// The period of the heartbeat (1017h, which is constant), in ms; 0 for none.
        heartbeat_ms: u16 = 1000 => [0];
        /// How long the device waits for its reset when an answer is on the bus, in ms, 10 to 1000:
        /// clients expect to see the answer first. With 15 a restart is a silence of less than 25 ms.
        answer_to_reset_ms: u32 = 15 => [50];
    };

    /// The SDO server.
    sdo: Sdo = Sdo::DEFAULT => [],
    #[derive(Copy)]
    struct Sdo {
        /// The COB-ID of requests, without the node-ID (`BLCOP_BASE_REQUEST`); `coflash
        /// --sdo-request`. Programs get it with the handoff. With no node-ID of `node.ids` may it be a
        /// COB-ID of NMT, SYNC, EMCY, TIME, LSS, boot-up or the other SDOs, or a reserved one (CiA 301:
        /// 000h to 180h, 580h to 67Fh, 6E0h to 7FFh); among those of PDOs (181h to 57Fh), these PDOs are
        /// then not for use on the bus.
        request_base: u16 = 0x600 => [0x300];
        /// The same for answers (`BLCOP_BASE_RESPONSE`); `coflash --sdo-response`.
        response_base: u16 = 0x580 => [0x480];
        /// Whether objects can be read by SDO block upload; the compact map has no room for it.
        block_upload: bool = SPLIT => [false];
        /// The received frames that may wait for the protocol, 8 to 255
        /// (`CDRV_MAX_RX_BUFF_ENTRIES_LOW`).
        receive_queue: u8 = 32 => [8];
    };

    /// SDO block download (`SDO_BLOCKTRANSFER`). With `None` the device answers 05040001h, and a master
    /// goes on in segments, which take two to three times as long; so on the compact map in the profiles
    /// `PAULUS` and `ESACADEMY`: the manual of the one has no SDO block transfer, and the paper of the
    /// other names none.
    block_download: Option<BlockDownload> = Some(BlockDownload::DEFAULT) => [None],
    #[derive(Copy)]
    struct BlockDownload {
        /// The segments of a sub-block at most, 1 to 127 (`SDO_BLOCKSIZE_DOWNLOAD`); at low bit rates
        /// the device takes fewer ([protocol](protocol.md#sdo)).
        segments_per_sub_block: u8 = 127 => [1];
        /// Whether there is a second SDO server (1201h), by which one master writes a program to several
        /// devices at once; the compact map has no room for it.
        second_server: bool = SPLIT => [false];
    };

    /// The download of programs.
    download: Download = Download::DEFAULT => [],
    #[derive(Copy)]
    struct Download {
        /// Whether a download of block files that was cut off can go on where it stopped (2006h); the
        /// compact map has no room for it.
        resume: bool = SPLIT => [false];
        /// Whether programs can be read where the dialect says so (lifts), and 100Ah is the version of
        /// the stored program; the compact map has no room for it.
        read_back: bool = SPLIT => [false];
        /// Whether date and time of the program can be read (1F52h), in the bootloader and in the
        /// program; the compact map has no room for it.
        program_date: bool = SPLIT => [false];
        /// Whether programs are taken as Intel HEX, too; on the compact map in the profile `ESACADEMY`
        /// alone.
        intel_hex: bool = SPLIT => [false];
        /// The CRC of blocks and programs (`BLCOP_USE_CRC16`); the compact map has no room for CRC-16.
        crc: CrcKind = CrcKind::Crc32 => [if SPLIT { CrcKind::Crc16 } else { CrcKind::Crc32 }];
        /// The bytes of flash that one step of a CRC covers, 64 to 65536
        /// (`BLCOP_MAX_CRC_STEP_SIZE`): other work of the same priority waits for one step at most.
        crc_step: u32 = 1024 => [64 * 1024];
        /// The bytes of blocks that may wait for the flash, 1024 up to the free RAM
        /// (`BLCOP_MAX_PROGRAM_BUFFER`): while a sector of 128 KiB is erased, a bus at 1 Mbit/s delivers
        /// some 55 KiB.
        block_buffer: usize = if SEALED { 48 * 1024 } else { 80 * 1024 } => [1024];
    };

    /// Functions of the product.
    hooks: Hooks = Hooks::DEFAULT => [],
    #[derive(Copy)]
    struct Hooks {
        /// The product's own check of block 0 and of the label in the image
        /// (`TgtProcessAppInfoData`). It gets the bytes of block 0, which may be any of the product's
        /// own: other lengths than 8, 12 and 24 are taken if it accepts them; it may refuse with any
        /// status, 7Eh (UNSPECIFIED) among them.
        check: fn(program: u8, info: &AppInfo<'_>) -> Verdict = |_, _| Verdict::Standard
            => [|_, _| Verdict::Accept];
        /// Whether programs may be changed now.
        programming_allowed: fn() -> bool = || true => [|| bsp::inputs('C') & 2 != 0];
        /// Whether CLEAR of a program erases with the first block or at once (`TgtCheckEraseApp`);
        /// `None` for the profile's.
        erase: Option<fn(program: u8) -> Erase> = None => [Some(|_| Erase::AtOnce)];
        /// Whether a released program may be started now, for instance by a port pin
        /// (`TgtCheckAppSig`). It runs in the boot stage, before any peripheral is set up, and when
        /// 2007h/2 is read, while the flash may be busy: it must read no flash, return at once, and
        /// leave the peripherals as it finds them (`bsp::inputs` does).
        start_allowed: fn(program: u8) -> bool = |_| true => [|_| bsp::inputs('C') & 1 != 0];
    };

    /// Other ways into the bootloader than a command and the entry strap. The compact map has no room
    /// for them in the largest product.
    ways_in: WaysIn = WaysIn::DEFAULT => [],
    #[derive(Copy)]
    struct WaysIn {
        /// Whether two resets by NRST within half a second keep the device in the bootloader
        /// ([below](#an-entry-without-a-pin)).
        two_resets: bool = false => [SPLIT];
        /// Whether 2008h starts the loader of ST in the chip's ROM ([below](#the-loader-in-the-rom)): who
        /// may write a program may then do anything with the device. Not with `sealed`.
        rom_loader: bool = false => [SPLIT];
    };

    /// The renewal of the bootloader itself over CAN ([renewal](renewal.md)); `None` for none. It needs
    /// `watchdog.bootloader_ms`, and a layout with `staging`.
    renewal: Option<Renewal> = if STAGING { Some(Renewal::DEFAULT) } else { None } => [None],
    #[derive(Copy)]
    struct Renewal {
        /// The time within which a master must confirm a new bootloader on trial, in s, 1 to 3600.
        confirm_within_s: u16 = 60 => [1];
        /// With `sealed`: the security counter of this bootloader; a device takes a new one only with a
        /// higher counter.
        counter: u32 = 0 => [3];
        /// The hardware revisions on which this bootloader runs: bit n for revision numbers (1018h/3)
        /// with n in the five lowest bits; 0 for all.
        revisions: u32 = 0 => [1];
    };

    /// Sealed images, in a bootloader with the feature `sealed` ([security](security.md)).
    seal: Seal = Seal::DEFAULT => [],
    #[derive(Copy)]
    struct Seal {
        /// The lowest security counter of an image, whatever is stored.
        counter: u32 = 0 => [5];
        /// Whether the counter is raised when a program is confirmed, and not when it is installed.
        counter_with_confirmation: bool = false => [true];
    };

    /// The bytes of the resident part that the devices in the field have, usually by `include_bytes!`;
    /// with `None` the build makes a fresh one
    /// ([below](#a-later-bootloader-for-the-resident-part-in-the-field)).
    resident: Option<&'static [u8]> = None => [];
}
