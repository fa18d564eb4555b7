/* Startup code from power-on to main: vectors, variables, floating-point unit, 168 MHz clock. */
#include <stdint.h>

#include "registers.h"

extern uint32_t _stack_top, _data_start_flash, _data_start, _data_end, _bss_start, _bss_end;

int main(void);
void reset(void);
void tick_interrupt(void);
void line_interrupt(void);
__attribute__((weak)) void can_transmit_interrupt(void);
__attribute__((weak)) void can_receive_interrupt(void);

/* Restart after an unexpected interrupt or a fault of the core. */
static void restart(void)
{
    SCB_AIRCR = 0x05FA0004u;
    for (;;) {
    }
}

__attribute__((section(".vectors"), used)) static void (*const vectors[16 + USART1_IRQ + 1])(void) = {
    [0] = (void (*)(void))(uintptr_t)&_stack_top,
    [1] = reset,
    [2 ... 14] = restart,
    [15] = tick_interrupt,
    [16 ... 15 + CAN1_TX_IRQ] = restart,
    [16 + CAN1_TX_IRQ] = can_transmit_interrupt,
    [16 + CAN1_RX0_IRQ] = can_receive_interrupt,
    [17 + CAN1_RX0_IRQ ... 15 + USART1_IRQ] = restart,
    [16 + USART1_IRQ] = line_interrupt,
};

/* Wait until bits are set, for a limited time: without a crystal, the internal clock stays in use. */
static uint32_t wait_for(volatile uint32_t *at, uint32_t bits)
{
    uint32_t left = 100000;

    while ((*at & bits) != bits && --left > 0u) {
    }
    return left;
}

/* 168 MHz from an 8 MHz crystal: 8 / 8 * 336 / 2; APB1 at 42 MHz, APB2 at 84 MHz. */
static void start_clock(void)
{
    RCC_CR |= 1u << 16; /* crystal */
    if (wait_for(&RCC_CR, 1u << 17) == 0u) {
        return; /* as in QEMU, which lacks this register and runs at 168 MHz */
    }
    FLASH_ACR = (7u << 8) | 5u; /* caches, prefetch, 5 wait states */
    RCC_PLLCFGR = 8u | (336u << 6) | (0u << 16) | (1u << 22) | (7u << 24);
    RCC_CFGR = (5u << 10) | (4u << 13);
    RCC_CR |= 1u << 24;
    if (wait_for(&RCC_CR, 1u << 25) != 0u) {
        RCC_CFGR |= 2u;
    }
}

void reset(void)
{
    uint32_t *to;
    const uint32_t *from = &_data_start_flash;

    SCB_CPACR |= 0xFu << 20;
    __asm volatile("dsb\n isb");
    for (to = &_data_start; to < &_data_end;) {
        *to++ = *from++;
    }
    for (to = &_bss_start; to < &_bss_end;) {
        *to++ = 0;
    }
    start_clock();
    (void)main();
    restart();
}
