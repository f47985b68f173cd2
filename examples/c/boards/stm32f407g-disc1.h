/* STM32F407G-DISC1 with a CAN transceiver on PD0 and PD1. */
#define CAN_PORT 'D'
#define CAN_RX_PIN 0
#define CAN_TX_PIN 1
/* LD4, green. */
#define LED_PORT 'D'
#define LED_PIN 12
#define HSE_HZ UINT32_C(8000000)
#define HSE_BYPASS 0
/* The device's identity, the same as the bootloader's (bsp/src/boards/stm32f407g_disc1.rs). */
#define VENDOR_ID UINT32_C(0)
#define PRODUCT_CODE UINT32_C(0x4007D151)
#define REVISION UINT32_C(0x00010000)
