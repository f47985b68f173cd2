#include "board.h"

#include BOARD
#include "registers.h"

/* Number of checks whether the crystal runs, and whether the core runs from it: some 100 ms. */
#define PATIENCE 200000

static volatile uint32_t now_ms;

void tick(void);

/* The handler of SysTick. */
void tick(void)
{
    now_ms++;
}

static void reset_unless(volatile uint32_t *from, uint32_t mask, uint32_t value)
{
    for (uint32_t i = 0; i < PATIENCE; i++) {
        if ((*from & mask) == value) {
            return;
        }
    }
    SCB_AIRCR = SCB_AIRCR_RESET;
    for (;;) {
    }
}

/* Runs the core from the crystal. If it does not start, the chip is reset: HSI is not exact enough for
 * CAN. After three such resets the bootloader keeps the device, and it can be reached.
 */
static void start_clock(void)
{
    RCC_CR |= HSE_BYPASS ? RCC_CR_HSEBYP : 0;
    RCC_CR |= RCC_CR_HSEON;
    reset_unless(&RCC_CR, RCC_CR_HSERDY, RCC_CR_HSERDY);
    /* One that fails later is an NMI: `crystal_failed` in startup.c. */
    RCC_CR |= RCC_CR_CSSON;
    RCC_CFGR = RCC_CFGR_SW_HSE;
    reset_unless(&RCC_CFGR, RCC_CFGR_SWS, RCC_CFGR_SWS_HSE);
}

static void set_up_pin(char port, unsigned pin, uint32_t mode, uint32_t alternate)
{
    RCC_AHB1ENR |= UINT32_C(1) << (port - 'A');
    (void)RCC_AHB1ENR;
    const unsigned place = 4 * (pin % 8);
    GPIO_AFR(port, pin) = (GPIO_AFR(port, pin) & ~(UINT32_C(0xF) << place)) | alternate << place;
    GPIO_MODER(port) = (GPIO_MODER(port) & ~(UINT32_C(3) << 2 * pin)) | mode << 2 * pin;
}

uint32_t board_start(void)
{
    start_clock();
    set_up_pin(CAN_PORT, CAN_RX_PIN, GPIO_MODE_ALTERNATE, GPIO_ALTERNATE_CAN1);
    set_up_pin(CAN_PORT, CAN_TX_PIN, GPIO_MODE_ALTERNATE, GPIO_ALTERNATE_CAN1);
    set_up_pin(LED_PORT, LED_PIN, GPIO_MODE_OUTPUT, 0);
    SYST_RVR = HSE_HZ / 1000 - 1;
    SYST_CVR = 0;
    SYST_CSR = SYST_CSR_ENABLE_INTERRUPT_CORE;
    return HSE_HZ;
}

uint32_t board_now_ms(void)
{
    return now_ms;
}

void board_toggle_led(void)
{
    GPIO_ODR(LED_PORT) ^= UINT32_C(1) << LED_PIN;
}

void board_wait(void)
{
    __asm volatile("wfi");
}
