//! A sealed image from its first byte on: its head is received, checked against the device, and
//! authenticated.

use seal::key_block::{KEKS, KEK_COUNT, KEY};
use seal::sha512::{hmac, Sha512};
use seal::wire::{array, flag, head_size, Fault, Head, Recipient, Requirements, WRAP_DOMAIN};
use shared_abi::geometry::Region;
use shared_abi::layout::Layout;
use shared_abi::renewal::BOOTLOADER;
use zeroize::Zeroize;

use super::buffers::{start, Buffers};
use super::content::{Acceptance, Content, Same};
use crate::flash::Flash;
use crate::keys::{floor, is_sound};
use crate::policy::SealPolicy;
use crate::queue::{Piece, Queue};
use crate::renewal::header;
use crate::store::{Key, Parameters, RenewalRecord, Value};

// `seal` depends on nothing, so it has the number, too.
const _: () = assert!(seal::wire::BOOTLOADER == BOOTLOADER);

/// The place of an image in the device, and the rules for it.
#[derive(Clone, Copy)]
pub(crate) struct Place {
    pub layout: &'static Layout,
    pub policy: &'static SealPolicy,
    pub program: u8,
    /// The program's flash.
    pub region: Region,
    /// The lowest security counter, if a client has the right to lower it.
    pub lowered_counter: Option<u32>,
    /// What the device has for a new RAM image; `None` if that cannot be renewed.
    pub has: Option<Requirements>,
    /// The image at home, if this is a new RAM image.
    pub home: Option<Region>,
}

/// An image that is being processed.
pub(super) struct Image {
    place: Place,
    stage: Stage,
}

/// The progress of an image.
enum Stage {
    /// The head is being received: the bytes that have arrived, and the required number.
    Head { have: usize, want: usize },
    /// The root's signature over the certificate is being checked.
    Certificate(Judged),
    /// The signature over the manifest is being checked.
    Manifest(Judged),
    /// The head is authentic; the rest is being processed.
    Content(Content),
    /// The flash contains the image.
    Installed(Installed),
}

/// An image that the flash contains.
struct Installed {
    acceptance: Acceptance,
    /// The new counter is not stored yet.
    raises: bool,
}

/// What there is to do with an image.
pub(crate) enum Progress {
    /// Nothing before more bytes arrive.
    Waits,
    /// The next step.
    Works,
    /// The flash contains it. `same`: it was already installed before, and this is the record to store.
    Installed { same: Option<Value> },
}

/// An image that is for this device, if its signatures are good.
#[derive(Clone, Copy)]
struct Judged {
    acceptance: Acceptance,
    /// For an encrypted image: the offset of the key-encryption key in the key block, and the
    /// offset of the recipient's record in the manifest.
    recipient: Option<(usize, usize)>,
}

impl Image {
    pub(super) const fn new(place: Place) -> Self {
        Self { place, stage: Stage::Head { have: 0, want: 8 } }
    }

    pub(super) const fn program(&self) -> u8 {
        self.place.program
    }

    /// What there is to do with it.
    pub(super) const fn progress(&self) -> Progress {
        match &self.stage {
            Stage::Head { .. } => Progress::Waits,
            Stage::Content(content) if content.waits() => Progress::Waits,
            Stage::Certificate(_) | Stage::Manifest(_) | Stage::Content(_) => Progress::Works,
            Stage::Installed(installed) => {
                let same = match installed.acceptance.same {
                    Some(same) => Some(same.record),
                    None => None,
                };
                Progress::Installed { same }
            }
        }
    }

    /// Returns the new counter of an installed image, once.
    pub(super) fn take_counter(&mut self) -> Option<Value> {
        let Stage::Installed(Installed { acceptance, raises }) = &mut self.stage else { return None };
        core::mem::take(raises).then_some(acceptance.counter)
    }

    /// The next bytes for the flash.
    pub(super) fn piece(&self) -> Option<Piece> {
        match &self.stage {
            Stage::Content(content) => content.piece(self.place.region),
            _ => None,
        }
    }

    /// The offset of these bytes in the buffer.
    pub(super) fn out(&self) -> usize {
        match &self.stage {
            Stage::Content(content) => content.out(),
            _ => 0,
        }
    }

    /// These bytes are in flash.
    pub(super) fn written(&mut self) {
        if let Stage::Content(content) = &mut self.stage {
            content.written();
        }
    }

    /// Whether its next step needs a good signature.
    pub(super) const fn has_signature(&self) -> bool {
        matches!(self.stage, Stage::Certificate(_) | Stage::Manifest(_))
    }

    /// Continues with one bounded step. If it [has a signature](Self::has_signature), that was found
    /// good. `accepted` is set when the manifest was found authentic.
    pub(super) fn advance<F: Flash>(
        &mut self,
        buffers: &mut Buffers,
        accepted: &mut bool,
        flash: &F,
        parameters: &impl Parameters,
        queue: &mut Queue<'_>,
    ) -> Result<(), Fault> {
        match &mut self.stage {
            Stage::Head { have, want } => {
                let room = buffers.head.get_mut(*have..*want).ok_or(Fault::Format)?;
                *have += queue.take(room);
                if have < want {
                    return Ok(());
                }
                *want = head_size(&buffers.head[..*have])?;
                if have == want {
                    self.stage = self.place.judge(buffers, flash, parameters)?;
                }
            }
            Stage::Certificate(judged) => {
                check_manifest(buffers, None)?;
                self.stage = Stage::Manifest(*judged);
            }
            Stage::Manifest(judged) => {
                judged.unwrap_key(self.place.layout, buffers, flash)?;
                *accepted = true;
                let dictionary = self.place.dictionary(buffers, flash, parameters)?;
                self.stage = Stage::Content(Content::new(judged.acceptance, dictionary, buffers));
            }
            Stage::Content(content) => {
                if content.advance(self.place.region, buffers, flash, queue)? {
                    buffers.wipe();
                    self.stage =
                        Stage::Installed(Installed { acceptance: content.acceptance(), raises: true });
                }
            }
            Stage::Installed(_) => {}
        }
        Ok(())
    }
}

impl Place {
    /// Checks the complete head, and starts to check its first signature.
    fn judge<F: Flash>(
        &self,
        buffers: &mut Buffers,
        flash: &F,
        parameters: &impl Parameters,
    ) -> Result<Stage, Fault> {
        let Self { policy, program, .. } = *self;
        let block = self.layout.key_block().base;
        // The key block without the secret keys; only the ids of these are read.
        let mut keys = [0; KEKS + KEK_COUNT * KEY];
        if is_sound(flash, block) {
            flash.read(block, &mut keys[..KEKS]);
            for at in (KEKS..).step_by(KEY).take(KEK_COUNT) {
                flash.read(block + at as u32, &mut keys[at..at + 4]);
            }
        }
        let (mut stored, epoch) = floor(flash, parameters, self.layout, policy.counter, program);
        if let Some(lowered) = self.lowered_counter {
            stored = stored.min(lowered);
        }
        let head = Head(&buffers.head);
        let same = match self.home {
            Some(home) => self.same_image(head, flash, parameters, home),
            None => self.same_program(head, flash, parameters),
        };
        let counter = match (self.home, same, self.lowered_counter) {
            // Two genuine images cannot be exchanged for ever.
            (Some(home), None, None) => stored.max(header(flash, home).counter.saturating_add(1)),
            _ => stored,
        };
        let needs = seal::judge::judge(
            head,
            &seal::judge::Device {
                vendor_id: policy.vendor_id,
                product_code: policy.product_code,
                revision: policy.revision,
                unique_id: (policy.unique_id)(),
                program,
                has: self.has,
                is_data: policy.data == Some(program),
                room: self.region.size,
                counter,
                epoch,
                keys: &keys,
            },
        )?;
        let with_confirmation = policy.counter_with_confirmation || self.home.is_some();
        let floor = if with_confirmation { stored.min(head.counter()) } else { head.counter() };
        let acceptance = Acceptance { same, counter: [floor, needs.epoch, head.counter(), 0] };
        let judged = Judged { acceptance, recipient: needs.recipient };
        let root = &keys[needs.root + 4..][..32];
        let root = root.try_into().map_err(|_| Fault::Key)?;
        match head.certificate() {
            Some(certificate) => {
                let signature = certificate.signature();
                start(&mut buffers.verification, root, &signature, &[certificate.signed()]);
                Ok(Stage::Certificate(judged))
            }
            None => {
                check_manifest(buffers, Some(root))?;
                Ok(Stage::Manifest(judged))
            }
        }
    }

    /// The program, if it is this one already.
    fn same_program<F: Flash>(
        &self,
        head: Head<'_>,
        flash: &F,
        parameters: &impl Parameters,
    ) -> Option<Same> {
        let record = parameters.program(flash, self.program)?;
        let [_, _, installed, _] = parameters.get(flash, Key::counter(self.program)).unwrap_or([0; 4]);
        let is_same = record.seal.is_some()
            && (record.size, record.crc, record.version) == (head.size(), head.crc(), head.version())
            && installed == head.counter();
        is_same.then(|| Same { place: self.region, record: record.value() })
    }

    /// The RAM image in staging or at home, if it is this one already. If it is at home, the record of
    /// another one in staging is removed: a start would try that one.
    fn same_image<F: Flash>(
        &self,
        head: Head<'_>,
        flash: &F,
        parameters: &impl Parameters,
        home: Region,
    ) -> Option<Same> {
        let staged = parameters.get(flash, Key::program(self.program));
        let staged = staged.filter(|value| RenewalRecord::from_value(*value).is_some());
        let staged = staged.map(|record| Same { place: self.region, record });
        let home = Same { place: home, record: RenewalRecord::NONE };
        [staged, Some(home)].into_iter().flatten().find(|Same { place, .. }| {
            let size = head.size();
            size <= place.size && flash.crc32(0, Region::new(place.base, size)) == head.crc()
        })
    }

    /// The other one of two programs, if it is the dictionary.
    fn dictionary<F: Flash>(
        &self,
        buffers: &Buffers,
        flash: &F,
        parameters: &impl Parameters,
    ) -> Result<Option<Region>, Fault> {
        if Head(&buffers.head).flags() & flag::DICTIONARY == 0 {
            return Ok(None);
        }
        let other = 3_u8.wrapping_sub(self.program);
        let place = self.layout.program(other);
        let record = parameters.program(flash, other);
        let (Some(place), Some(record)) = (place, record) else { return Err(Fault::WrongProduct) };
        Ok(Some(Region::new(place.base, record.size.min(place.size))))
    }
}

impl Judged {
    /// Unwraps the key of the chunks, if they are encrypted, at its place in the buffers: nothing of it, or
    /// of the key-encryption key, stays on the stack.
    fn unwrap_key<F: Flash>(&self, layout: &Layout, buffers: &mut Buffers, flash: &F) -> Result<(), Fault> {
        let Some((at, recipient)) = self.recipient else { return Ok(()) };
        let head = Head(&buffers.head);
        let recipient = array(head.0, recipient);
        let recipient = Recipient(&recipient);
        let mut secret = [0; 32];
        flash.read(layout.key_block().base + at as u32 + 4, &mut secret);
        let mut stream = hmac(&secret, &[WRAP_DOMAIN, &head.nonce()]);
        secret.zeroize();
        let is_ours = stream[32..40] == recipient.check();
        if is_ours {
            for ((key, wrapped), stream) in buffers.key.iter_mut().zip(recipient.wrapped()).zip(&stream) {
                *key = wrapped ^ stream;
            }
        }
        stream.zeroize();
        is_ours.then_some(()).ok_or(Fault::Key)
    }
}

/// Starts to check the signature over the manifest, with this root or with the key in the
/// certificate.
fn check_manifest(buffers: &mut Buffers, root: Option<&[u8; 32]>) -> Result<(), Fault> {
    let head = Head(&buffers.head);
    let certified = head.certificate().map(|certificate| certificate.key());
    let key = certified.as_ref().or(root).ok_or(Fault::Key)?;
    let signature = head.signature(key_id(key)).ok_or(Fault::Signature)?;
    start(&mut buffers.verification, key, signature, &[head.domain(), head.manifest()]);
    Ok(())
}

/// The new counter of a program before its record is removed: the counter of a program that has
/// proved itself. It is stored even if it already has this value: after a power cut it may read
/// this way now and differently later. (The store writes nothing if it is certain.)
pub(crate) fn proved<F: Flash>(flash: &F, parameters: &impl Parameters, program: u8) -> Option<Value> {
    if program == BOOTLOADER {
        // Its counter is raised with the confirmation, and by nothing else.
        return None;
    }
    let record = parameters.program(flash, program)?;
    let [counter, epoch, installed, _] = parameters.get(flash, Key::counter(program))?;
    (record.confirmed && installed >= counter).then_some([installed, epoch, installed, 0])
}

/// The id of a key: the first four bytes of its hash.
fn key_id(key: &[u8; 32]) -> u32 {
    let mut hash = Sha512::new();
    hash.update(key);
    seal::wire::word(&hash.finish(), 0)
}
