/* The start of this program, from the bootloader's jump to `main`, and the vectors. */
#include "coboot/coboot.h"
#include "registers.h"

extern uint32_t _stack_start, __data_start, __data_end, __bss_start, __bss_end;
extern const uint32_t __data_load;
/* Functions that run before `main`: the constructors of static objects in C++. */
extern void (*const __init_array_start[])(void);
extern void (*const __init_array_end[])(void);

int main(void);
void tick(void);
void reset(void);

/* Resets the device on an exception without a handler; then the bootloader decides what runs. */
static void unexpected(void)
{
    SCB_AIRCR = SCB_AIRCR_RESET;
    for (;;) {
    }
}

/* The NMI: the clock security system has put HSI in the place of the crystal (RM0090 section 7.2.7). It is no crash of
 * the program, and the next start finds whether the crystal runs again.
 */
static void crystal_failed(void)
{
    coboot_reset(COBOOT_REQUEST_POWER_ON, 0);
}

/* The vectors of the core, and the interrupt lines of the chip, whose number comes from the build.
 * The label follows the vectors, so more vectors do not fit; the linker script compares the number
 * with the chip's.
 */
enum { EXCEPTIONS = 16, VECTORS = EXCEPTIONS + INTERRUPT_LINES };

typedef void (*vector)(void);

__attribute__((section(".vector_table"), used)) static const vector vectors[VECTORS] = {
    [0] = (vector)(uintptr_t)&_stack_start,
    [1] = reset,
    [2] = crystal_failed,
    [3 ... 14] = unexpected,
    [15] = tick,
    [EXCEPTIONS ... VECTORS - 1] = unexpected,
};

void reset(void)
{
    /* The bootloader has set it; a debugger may not have. */
    SCB_VTOR = (uint32_t)(uintptr_t)vectors;
    /* Volatile: otherwise the compiler would call a library for these loops. */
    const volatile uint32_t *from = &__data_load;
    for (volatile uint32_t *to = &__data_start; to < &__data_end; to++, from++) {
        *to = *from;
    }
    for (volatile uint32_t *to = &__bss_start; to < &__bss_end; to++) {
        *to = 0;
    }
    for (void (*const *function)(void) = __init_array_start; function < __init_array_end; function++) {
        (*function)();
    }
    main();
    unexpected();
}
