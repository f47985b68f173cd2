/* NUCLEO-F446RE with a CAN transceiver on PB8 and PB9. */
#define CAN_PORT 'B'
#define CAN_RX_PIN 8
#define CAN_TX_PIN 9
/* LD2, green. */
#define LED_PORT 'A'
#define LED_PIN 5
/* From the ST-LINK. */
#define HSE_HZ UINT32_C(8000000)
#define HSE_BYPASS 1
/* The device's identity, the same as the bootloader's (bsp/src/boards/nucleo_f446re.rs). */
#define VENDOR_ID UINT32_C(0)
#define PRODUCT_CODE UINT32_C(0x446E0064)
#define REVISION UINT32_C(0x00010000)
