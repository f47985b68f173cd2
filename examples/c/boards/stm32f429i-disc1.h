/* STM32F429I-DISC1 with a CAN transceiver on PB8 and PB9; its display must not be used. */
#define CAN_PORT 'B'
#define CAN_RX_PIN 8
#define CAN_TX_PIN 9
/* LD3, green. */
#define LED_PORT 'G'
#define LED_PIN 13
#define HSE_HZ UINT32_C(8000000)
#define HSE_BYPASS 0
/* The device's identity, the same as the bootloader's (bsp/src/boards/stm32f429i_disc1.rs). */
#define VENDOR_ID UINT32_C(0)
#define PRODUCT_CODE UINT32_C(0x4291D151)
#define REVISION UINT32_C(0x00010000)
