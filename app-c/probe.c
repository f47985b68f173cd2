#include "probe.h"

#include "coboot.h"
#include "registers.h"

extern uint32_t __bss_end;

uint32_t probe_values[PROBE_LAST + 1] = { [0] = PROBE_LAST };

void probe_init(void)
{
    probe_values[PROBE_ADDRESS] = (uint32_t)(uintptr_t)&probe_values[PROBE_WORD];
    probe_values[PROBE_POINTER] = probe_values[PROBE_ADDRESS];
}

/* What stands in a free cell of RAM. */
static inline uint32_t pattern(const volatile uint32_t *cell, uint32_t seed)
{
    return ((uint32_t)(uintptr_t)cell ^ seed) * COBOOT_CHECK_FACTOR;
}

/* All RAM that this program does not use lies between its variables and its stack pointer. It is filled before the call; the
 * lowest cell that the call has changed tells how deep its stack went, and that it wrote nowhere else.
 *
 * Nothing may be pushed between filling and calling, and no interrupt may come: so it is one function of its own.
 */
__attribute__((noinline)) void probe_call(void)
{
    const struct coboot_callgate *gate = coboot_callgate();
    if (gate == NULL) {
        probe_values[PROBE_CALL] = (uint32_t)COBOOT_STATUS_UNKNOWN_SELECTOR;
        return;
    }
    const uint32_t selector = probe_values[PROBE_SELECTOR];
    void *const args = (void *)(uintptr_t)probe_values[PROBE_POINTER];
    const uint32_t seed = probe_values[PROBE_SEED];
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

    probe_values[PROBE_CALL] = (uint32_t)status;
    probe_values[PROBE_SP] = (uint32_t)(uintptr_t)sp;
    probe_values[PROBE_STACK] = (uint32_t)((uintptr_t)sp - (uintptr_t)changed);
}

void probe_open_flash(void)
{
    if (probe_values[PROBE_FLASH_OPEN] == 0) {
        FLASH_CR = FLASH_CR_LOCK;
    } else if ((FLASH_CR & FLASH_CR_LOCK) != 0) {
        FLASH_KEYR = FLASH_KEY_1;
        FLASH_KEYR = FLASH_KEY_2;
    }
}
