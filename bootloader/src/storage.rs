//! The flash and the store for the RAM image: flash operations are started and polled here, and the
//! resident part does everything else ([`shared_abi::services`]).

use core::task::Poll;

use boot_core::canopen::program::Supply;
use boot_core::flash::{Flash, FlashFault, Next, Operation};
use boot_core::store::{Key, Parameters, StoreError, Value};
use bsp::{supply, LAYOUT};
use shared_abi::geometry::{Region, Sector};
use shared_abi::services::{OperationResult, Services, Step, StoreState, ERASE, OFFSET};

use crate::flash_controller::FlashController;

/// The resident part's services.
fn services() -> &'static Services {
    // SAFETY: the linker script places the resident part at the callgate's address, and its header
    // has the table at this offset.
    let services = unsafe { &*((LAYOUT.callgate() + OFFSET) as *const Services) };
    // The boot stage has compared the versions; this check finds a table at a wrong address.
    debug_assert!(services.size as usize >= size_of::<Services>());
    services
}

/// A sector in the words of the services.
fn sector([number, base, size]: [u32; 3]) -> Sector {
    Sector { number: number as u8, region: Region::new(base, size) }
}

/// The flash, for the RAM image.
pub struct BootFlash(FlashController);

impl BootFlash {
    /// Takes the flash controller.
    ///
    /// # Safety
    /// Nothing else may use it, or the CRC unit, until this value is dropped.
    pub unsafe fn steal() -> Self {
        // SAFETY: the caller guarantees it.
        Self(unsafe { FlashController::steal() })
    }

    /// The services. The flash must be idle: otherwise code in flash stalls, and all interrupts
    /// with it.
    fn idle_services(&self) -> &'static Services {
        debug_assert!(!self.0.is_busy(), "a service was called while the flash works");
        services()
    }
}

impl Flash for BootFlash {
    fn read(&self, address: u32, buffer: &mut [u8]) {
        self.0.read(address, buffer);
    }

    fn read_word(&self, address: u32) -> u32 {
        self.0.read_word(address)
    }

    fn start(&mut self, operation: Operation) -> Result<(), FlashFault> {
        if self.supply() == Supply::Low {
            return Err(FlashFault::Supply);
        }
        self.0.start(operation)
    }

    fn poll(&mut self) -> Poll<Result<(), FlashFault>> {
        self.0.poll()
    }

    fn is_protected(&self, sector: Sector) -> bool {
        self.0.is_protected(sector.number)
    }

    fn supply(&self) -> Supply {
        supply::state()
    }

    fn option_bytes(&self) -> u32 {
        self.0.option_bytes()
    }

    fn sector_at(&self, address: u32) -> Option<Sector> {
        let mut words = [0; 3];
        // SAFETY: the words are writable.
        let found = unsafe { (self.idle_services().sector_at)(address, &mut words) };
        (found != 0).then(|| sector(words))
    }

    fn crc32(&self, crc: u32, region: Region) -> u32 {
        (self.idle_services().crc32)(crc, region.base, region.size)
    }

    fn is_blank(&self, region: Region) -> bool {
        (self.idle_services().is_blank)(region.base, region.size) != 0
    }
}

/// The stored values.
pub struct Store {
    state: &'static mut StoreState,
    /// A value that came while the flash may have worked: the next call of [`next`](Parameters::next) takes it.
    waiting: Option<(Key, Value)>,
}

impl Store {
    /// Finds the stored values. The flash must be idle.
    pub fn open(state: &'static mut StoreState) -> Self {
        // SAFETY: no other code uses the state.
        unsafe { (services().open)(state) };
        Self { state, waiting: None }
    }
}

impl Parameters for Store {
    fn services(&self) -> u32 {
        services().version
    }

    fn facts(&self) -> u32 {
        let Services { facts, crc32, .. } = services();
        crc32(0, &raw const **facts as u32, facts.size.into())
    }

    fn get<F: Flash>(&self, _flash: &F, key: Key) -> Option<Value> {
        let mut value = [0; 4];
        // SAFETY: the state comes from `open`.
        unsafe { ((services().get)(&*self.state, key.0, &mut value) != 0).then_some(value) }
    }

    fn store(&mut self, key: Key, value: Value) {
        // The journal may be being erased: a service would stop the core until the end of that.
        self.waiting = Some((key, value));
    }

    fn compact(&mut self, used: u32) -> bool {
        // SAFETY: the state comes from `open`.
        unsafe { (services().compact)(&mut *self.state, used) != 0 }
    }

    fn next<F: Flash>(&mut self, _flash: &F, outcome: Result<(), FlashFault>) -> Next<StoreError> {
        if let Some((key, value)) = self.waiting.take() {
            // SAFETY: the state comes from `open`.
            unsafe { (services().store)(&mut *self.state, key.0, &value) };
        }
        let result = match outcome {
            Ok(()) => OperationResult::Done,
            Err(FlashFault::Protected) => OperationResult::Protected,
            // The services know no reason but these.
            Err(FlashFault::Failed | FlashFault::Supply) => OperationResult::Failed,
            Err(FlashFault::Verify) => OperationResult::NotVerified,
        };
        let mut operation = [0; 4];
        // SAFETY: the state comes from `open`, and the words are writable.
        let step = unsafe { (services().next)(&mut *self.state, result as u32, &mut operation) };
        match (Step::from_number(step), operation) {
            (Step::Start, [ERASE, place @ ..]) => Next::Start(Operation::Erase(sector(place))),
            (Step::Start, [_, address, word, _]) => Next::Start(Operation::Program { address, word }),
            (Step::Again, _) => Next::Again,
            (Step::Done, _) => Next::Done(Ok(())),
            (Step::Failed, _) => Next::Done(Err(StoreError::Device)),
        }
    }
}
