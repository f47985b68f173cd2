// A small CANopen node in C++17 under coboot. What it does for its bootloader is in examples/c/coboot/, which is C; the other
// files of examples/c/ are its CAN controller, its SDO server and its board.
#include BOARD

#include "board.h"
#include "can.h"
#include "objects.h"
#include "sdo.h"

// Whom this image is for: coflash and the bootloader refuse it for other devices.
COBOOT_LABEL(VENDOR_ID, PRODUCT_CODE, VERSION);

// What coboot knows of this program.
coboot_program program;

// Whether the device may leave now, for its bootloader or for a reset. It is asked once, before a
// command is answered: 1F51h = 80h, 0, 2 and 3. A machine that moves answers false, and the command
// is refused. After true the reset follows within half a second: until then nothing may start to
// move that stands (coboot_program_leaving).
static bool may_leave()
{
    return true;
}

// The callback of a download to 1F51h, before it is answered.
uint32_t app_cb_program_ctrl(uint8_t sub, uint32_t value)
{
    return coboot_program_write(&program, COBOOT_PROGRAM_CONTROL, sub, value, board_now_ms());
}

namespace {

// Without a bootloader, or where it leaves the bit rate to be found out, which this program cannot do.
constexpr uint8_t DEFAULT_NODE_ID = 1;
constexpr uint32_t DEFAULT_BIT_RATE = 125'000;

// NMT states as a heartbeat reports them (CiA 301).
enum class State : uint8_t { BootUp = 0, Stopped = 4, Operational = 5, PreOperational = 127 };

// Reports every so many milliseconds that it is time. Its constructor runs before `main`.
class Timer {
public:
    explicit Timer(uint32_t period_ms) : period_ms_(period_ms) {}

    void set_period(uint32_t period_ms)
    {
        period_ms_ = period_ms;
        at_ms_ = board_now_ms() + period_ms;
    }

    // 0: never.
    bool is_due() const
    {
        return period_ms_ != 0 && static_cast<int32_t>(board_now_ms() - at_ms_) >= 0;
    }

    void restart() { at_ms_ = board_now_ms() + period_ms_; }

    uint32_t &period_ms() { return period_ms_; }

private:
    uint32_t period_ms_;
    uint32_t at_ms_ = 0;
};

class Node {
public:
    // Takes what has come, and sends what is due, as long as the bootloader does not answer in its place.
    void serve()
    {
        can_frame frame;
        // A request stays in the FIFO until its answer has room.
        while (!coboot_program_is_silent(&program) && can_is_free(CAN_SDO) && can_receive(&frame)) {
            take(frame);
        }
        if (heartbeat.is_due() && !coboot_program_is_silent(&program) && can_is_free(CAN_HEARTBEAT)) {
            heartbeat.restart();
            send(state_);
        }
    }

    void send(State state) const
    {
        const can_frame frame = { static_cast<uint16_t>(0x700 + program.node_id), 1, { static_cast<uint8_t>(state) } };
        can_send(CAN_HEARTBEAT, &frame);
    }

    Timer heartbeat{1000};

private:
    void take(const can_frame &frame)
    {
        can_frame answer = { static_cast<uint16_t>(0x580 + program.node_id), 8, {} };
        if (frame.id == 0) {
            command(frame);
        } else if (frame.len == 8 && state_ != State::Stopped && sdo_answer(frame.data, answer.data)
                   && !coboot_program_is_silent(&program)) {
            can_send(CAN_SDO, &answer);
        }
    }

    // Network management (CiA 301).
    void command(const can_frame &frame)
    {
        if (frame.len != 2 || (frame.data[1] != 0 && frame.data[1] != program.node_id)) {
            return;
        }
        switch (frame.data[0]) {
        case 1:
            state_ = State::Operational;
            break;
        case 2:
            state_ = State::Stopped;
            break;
        case 128:
            state_ = State::PreOperational;
            break;
        case 129: // Reset node, reset communication: there is little to reset, so both go through a reset.
        case 130:
            coboot_program_nmt_reset(&program, board_now_ms());
            break;
        default:
            break;
        }
    }

    State state_ = State::PreOperational;
};

Node node;

uint32_t device_type = 0; // No profile; the bootloader's is another.
uint32_t error_register = 0;
uint32_t identity[] = { 4, VENDOR_ID, PRODUCT_CODE, REVISION, 0 };

void start_can(uint32_t clock)
{
    const auto requests = static_cast<uint16_t>(0x600 + program.node_id);
    if (!can_start(clock, program.bit_rate, 0, requests)) {
        // The bootloader comes up with another bit rate.
        program.bootloader_answers = false;
        (void)can_start(clock, DEFAULT_BIT_RATE, 0, requests);
    }
}

} // namespace

const object objects[] = {
    { 0x1000, 0, 4, &device_type, nullptr },
    { 0x1001, 0, 1, &error_register, nullptr },
    { 0x1017, 0, 2, &node.heartbeat.period_ms(),
      [](uint8_t, uint32_t value) -> uint32_t {
          node.heartbeat.set_period(value);
          return COBOOT_ABORT_NONE;
      } },
    { 0x1018, 0, 1, &identity[0], nullptr },
    { 0x1018, 1, 4, &identity[1], nullptr },
    { 0x1018, 2, 4, &identity[2], nullptr },
    { 0x1018, 3, 4, &identity[3], nullptr },
    { 0x1018, 4, 4, &identity[4], nullptr },
    {},
};

// Freestanding, `main` is a function like others: the start-up calls it by its name in C.
extern "C" int main()
{
    coboot_program_init(&program, DEFAULT_NODE_ID, DEFAULT_BIT_RATE);
    program.may_leave = may_leave;
    if (program.nameplate != nullptr) {
        identity[1] = program.nameplate->vendor_id;
        identity[2] = program.nameplate->product_code;
        identity[3] = program.nameplate->revision;
    }
    identity[4] = program.serial_number;
    start_can(board_start());
    node.send(State::BootUp);
    node.heartbeat.restart();

    Timer blink{500};
    for (;;) {
        coboot_program_proceed(&program, can_is_free(CAN_SDO) && can_is_free(CAN_HEARTBEAT), board_now_ms());
        node.serve();
        if (blink.is_due()) {
            blink.restart();
            board_toggle_led();
        }
        if (!coboot_program_is_silent(&program)) {
            board_wait();
        }
    }
}
