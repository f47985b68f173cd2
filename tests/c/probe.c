/* Object 2100h: the callgate by hand, for the tests (tests/device/c_application.rs), so that a client can call each service
 * with arguments of its own, bad ones too. It adds its objects to those of the application in C; no product has it.
 */
#include "coboot/coboot.h"
#include "objects.h"
#include "registers.h"

/* RM0090 sections 3.6.1 and 3.9. */
#define FLASH_KEYR REGISTER(0x40023C04)
#define FLASH_KEY_1 UINT32_C(0x45670123)
#define FLASH_KEY_2 UINT32_C(0xCDEF89AB)
#define FLASH_CR REGISTER(0x40023C10)
#define FLASH_CR_LOCK (UINT32_C(1) << 31)

/* RM0090 section 4.4: the CRC unit, and the bit of its clock in RCC_AHB1ENR. */
#define CRC_DR REGISTER(0x40023000)
#define CRC_CR REGISTER(0x40023008)
#define CRC_CR_RESET UINT32_C(1)
#define RCC_AHB1ENR_CRCEN (UINT32_C(1) << 12)

/* ARMv7-M C1.6.5 and C1.8.7: the cycle counter. */
#define DEMCR REGISTER(0xE000EDFC)
#define DEMCR_TRCENA (UINT32_C(1) << 24)
#define DWT_CTRL REGISTER(0xE0001000)
#define DWT_CYCCNT REGISTER(0xE0001004)

/* Sub-indices. */
enum {
    SELECTOR = 1,
    /* What is handed over: ADDRESS is good, everything else is a lie. */
    POINTER = 2,
    /* The words of the argument structure, up to WORD + 4. */
    WORD = 3,
    /* Written: calls. Read: the status of the last call. */
    CALL = 8,
    /* Bytes of stack that the last call wrote to. */
    STACK = 9,
    /* Where the argument structure is. */
    ADDRESS = 10,
    /* What all free RAM is filled with before a call: seed of a pattern. */
    SEED = 11,
    /* 1: this program has the flash controller open, as somebody who is programming; 0: it is locked. */
    FLASH_OPEN = 12,
    /* Where the stack pointer was at the last call. */
    SP = 13,
    /* Written: calls as an application does, with its interrupts on. The value is what the interrupt of the tick does
     * with the CRC unit meanwhile, see TICK_. */
    PLAIN_CALL = 14,
    /* How long the last of these calls took, in cycles of the core. */
    CYCLES = 15,
    /* 1: the machine of this program moves, so the device may not leave. */
    MOVES = 16,
    LAST = MOVES,
};

extern uint32_t __bss_end;

static uint32_t values[LAST + 1] = {
    [0] = LAST,
    [POINTER] = (uint32_t)&values[WORD],
    [ADDRESS] = (uint32_t)&values[WORD],
};

/* What is in a free cell of RAM. */
static inline uint32_t pattern(const volatile uint32_t *cell, uint32_t seed)
{
    return ((uint32_t)(uintptr_t)cell ^ seed) * COBOOT_CHECK_FACTOR;
}

/* All RAM that this program does not use lies between its variables and its stack pointer. It is filled before the call; the
 * lowest cell that the call has changed shows how deep its stack went, and that it wrote nowhere else.
 *
 * Nothing may be pushed between filling and calling, and no interrupt may come: so it is one function of its own.
 */
__attribute__((noinline)) static uint32_t call(uint8_t sub, uint32_t ignored)
{
    const struct coboot_callgate *gate = coboot_callgate();
    (void)sub;
    (void)ignored;
    if (gate == NULL) {
        values[CALL] = (uint32_t)COBOOT_STATUS_UNKNOWN_SELECTOR;
        return COBOOT_ABORT_NONE;
    }
    const uint32_t selector = values[SELECTOR];
    void *const args = (void *)(uintptr_t)values[POINTER];
    const uint32_t seed = values[SEED];
    volatile uint32_t *const lowest = &__bss_end;
    volatile uint32_t *sp;

    __asm volatile("cpsid i" ::: "memory");
    __asm volatile("mov %0, sp" : "=r"(sp));
    for (volatile uint32_t *cell = lowest; cell < sp; cell++) {
        *cell = pattern(cell, seed);
    }
    const int32_t status = coboot_call(gate, selector, args);
    volatile uint32_t *changed = lowest;
    while (changed < sp && *changed == pattern(changed, seed)) {
        changed++;
    }
    __asm volatile("cpsie i" ::: "memory");

    values[CALL] = (uint32_t)status;
    values[SP] = (uint32_t)(uintptr_t)sp;
    values[STACK] = (uint32_t)((uintptr_t)sp - (uintptr_t)changed);
    return COBOOT_ABORT_NONE;
}

enum { TICK_USES_NOTHING, TICK_USES_CRC, TICK_KEEPS_CRC };

/* The vectors of the core, with a tick of our own (ARMv7-M B3.2.5: aligned to their number). */
static void (*vectors[128])(void) __attribute__((aligned(512)));
static void (*old_tick)(void);
static volatile uint32_t use;

static void tick_with_crc(void)
{
    if (use != TICK_USES_NOTHING) {
        RCC_AHB1ENR |= RCC_AHB1ENR_CRCEN;
        CRC_CR = CRC_CR_RESET;
        CRC_DR = UINT32_C(0x12345678);
        if (use == TICK_USES_CRC) {
            RCC_AHB1ENR &= ~RCC_AHB1ENR_CRCEN;
        }
    }
    old_tick();
}

static uint32_t plain_call(uint8_t sub, uint32_t value)
{
    const struct coboot_callgate *gate = coboot_callgate();
    void (**const old_vectors)(void) = (void (**)(void))(uintptr_t)SCB_VTOR;

    for (uint32_t n = 0; n < 128; n++) {
        vectors[n] = old_vectors[n];
    }
    old_tick = old_vectors[15];
    vectors[15] = tick_with_crc;
    DEMCR |= DEMCR_TRCENA;
    DWT_CTRL |= 1;
    use = value;
    SCB_VTOR = (uint32_t)(uintptr_t)vectors;
    const uint32_t from = DWT_CYCCNT;
    values[CALL] = (uint32_t)coboot_call(gate, values[SELECTOR], (void *)(uintptr_t)values[POINTER]);
    values[CYCLES] = DWT_CYCCNT - from;
    SCB_VTOR = (uint32_t)(uintptr_t)old_vectors;
    values[sub] = value;
    return COBOOT_ABORT_NONE;
}

static uint32_t set(uint8_t sub, uint32_t value)
{
    values[sub] = value;
    return COBOOT_ABORT_NONE;
}

static bool stands(void)
{
    return values[MOVES] == 0;
}

static uint32_t move(uint8_t sub, uint32_t value)
{
    program.may_leave = stands;
    return set(sub, value);
}

static uint32_t open_flash(uint8_t sub, uint32_t value)
{
    if (value == 0) {
        FLASH_CR = FLASH_CR_LOCK;
    } else if ((FLASH_CR & FLASH_CR_LOCK) != 0) {
        FLASH_KEYR = FLASH_KEY_1;
        FLASH_KEYR = FLASH_KEY_2;
    }
    return set(sub, value);
}

const struct object more_objects[] = {
    { 0x2100, 0, 1, &values[0], NULL },
    { 0x2100, SELECTOR, 4, &values[SELECTOR], set },
    { 0x2100, POINTER, 4, &values[POINTER], set },
    { 0x2100, WORD + 0, 4, &values[WORD + 0], set },
    { 0x2100, WORD + 1, 4, &values[WORD + 1], set },
    { 0x2100, WORD + 2, 4, &values[WORD + 2], set },
    { 0x2100, WORD + 3, 4, &values[WORD + 3], set },
    { 0x2100, WORD + 4, 4, &values[WORD + 4], set },
    { 0x2100, CALL, 4, &values[CALL], call },
    { 0x2100, STACK, 4, &values[STACK], NULL },
    { 0x2100, ADDRESS, 4, &values[ADDRESS], NULL },
    { 0x2100, SEED, 4, &values[SEED], set },
    { 0x2100, FLASH_OPEN, 4, &values[FLASH_OPEN], open_flash },
    { 0x2100, SP, 4, &values[SP], NULL },
    { 0x2100, PLAIN_CALL, 4, &values[PLAIN_CALL], plain_call },
    { 0x2100, CYCLES, 4, &values[CYCLES], NULL },
    { 0x2100, MOVES, 4, &values[MOVES], move },
    { 0 },
};
