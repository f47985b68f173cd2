/* The registers that this application uses, with their names in RM0090 (STM32F405 to F439) and
 * RM0390 (STM32F446): a register in both manuals is the same. Those of the core are in the ARMv7-M
 * manual, B3.
 */
#ifndef REGISTERS_H
#define REGISTERS_H

#include <stdint.h>

#define REGISTER(address) (*(volatile uint32_t *)(uintptr_t)(address))

/* RM0090 section 7.3. */
#define RCC_CR REGISTER(0x40023800)
#define RCC_CR_HSEON (UINT32_C(1) << 16)
#define RCC_CR_HSERDY (UINT32_C(1) << 17)
#define RCC_CR_HSEBYP (UINT32_C(1) << 18)
#define RCC_CR_CSSON (UINT32_C(1) << 19)
#define RCC_CFGR REGISTER(0x40023808)
#define RCC_CFGR_SW_HSE UINT32_C(1)
#define RCC_CFGR_SWS (UINT32_C(3) << 2)
#define RCC_CFGR_SWS_HSE (UINT32_C(1) << 2)
#define RCC_AHB1ENR REGISTER(0x40023830)
#define RCC_APB1ENR REGISTER(0x40023840)
#define RCC_APB1ENR_CAN1EN (UINT32_C(1) << 25)

/* RM0090 section 8.4. Ports are 400h apart; RCC_AHB1ENR has their clocks from bit 0 on. */
#define GPIO(port) (UINT32_C(0x40020000) + UINT32_C(0x400) * ((port) - 'A'))
#define GPIO_MODER(port) REGISTER(GPIO(port) + 0x00)
#define GPIO_MODE_OUTPUT UINT32_C(1)
#define GPIO_MODE_ALTERNATE UINT32_C(2)
#define GPIO_ODR(port) REGISTER(GPIO(port) + 0x14)
#define GPIO_AFR(port, pin) REGISTER(GPIO(port) + 0x20 + 4 * ((pin) / 8))
/* CAN1 on all its pins (DS8626 table 9, DS10693 table 11). */
#define GPIO_ALTERNATE_CAN1 UINT32_C(9)

/* RM0090 section 32.9. */
#define CAN1 UINT32_C(0x40006400)
#define CAN_MCR REGISTER(CAN1 + 0x000)
#define CAN_MCR_INRQ (UINT32_C(1) << 0)
#define CAN_MCR_ABOM (UINT32_C(1) << 6)
#define CAN_MSR REGISTER(CAN1 + 0x004)
#define CAN_MSR_INAK (UINT32_C(1) << 0)
#define CAN_TSR REGISTER(CAN1 + 0x008)
#define CAN_TSR_TME(mailbox) (UINT32_C(1) << (26 + (mailbox)))
#define CAN_RF0R REGISTER(CAN1 + 0x00C)
#define CAN_RF0R_FMP0 UINT32_C(3)
#define CAN_RF0R_RFOM0 (UINT32_C(1) << 5)
#define CAN_BTR REGISTER(CAN1 + 0x01C)
#define CAN_TIR(mailbox) REGISTER(CAN1 + 0x180 + 0x10 * (mailbox))
#define CAN_TIR_TXRQ (UINT32_C(1) << 0)
#define CAN_TDTR(mailbox) REGISTER(CAN1 + 0x184 + 0x10 * (mailbox))
#define CAN_TDLR(mailbox) REGISTER(CAN1 + 0x188 + 0x10 * (mailbox))
#define CAN_TDHR(mailbox) REGISTER(CAN1 + 0x18C + 0x10 * (mailbox))
#define CAN_RI0R REGISTER(CAN1 + 0x1B0)
#define CAN_RDT0R REGISTER(CAN1 + 0x1B4)
#define CAN_RDL0R REGISTER(CAN1 + 0x1B8)
#define CAN_RDH0R REGISTER(CAN1 + 0x1BC)
#define CAN_FMR REGISTER(CAN1 + 0x200)
#define CAN_FMR_FINIT (UINT32_C(1) << 0)
#define CAN_FM1R REGISTER(CAN1 + 0x204)
#define CAN_FA1R REGISTER(CAN1 + 0x21C)
#define CAN_F0R1 REGISTER(CAN1 + 0x240)
#define CAN_F0R2 REGISTER(CAN1 + 0x244)

#define SYST_CSR REGISTER(0xE000E010)
#define SYST_CSR_ENABLE_INTERRUPT_CORE UINT32_C(7)
#define SYST_RVR REGISTER(0xE000E014)
#define SYST_CVR REGISTER(0xE000E018)
#define SCB_VTOR REGISTER(0xE000ED08)
#define SCB_AIRCR REGISTER(0xE000ED0C)
#define SCB_AIRCR_RESET UINT32_C(0x05FA0004)

#endif
