/* Implementation of hal.h on an STM32F405 without a library: clock, serial line (USART1, pins A9, A10), watchdog.
 * Motors and sensors are in drivers/. */
#include "hal.h"

#include "board.h"
#include "drivers.h"
#include "registers.h"

#define CLOCK 168u /* MHz */
#define STEP 250u  /* us between two interrupts of the system timer: timing accuracy of states */
#define RING 1024u /* bytes; a power of two */

static volatile uint64_t steps;
static volatile uint32_t received, sent; /* number of bytes received and sent */
static uint32_t taken, written;          /* number of bytes read and written by the program */
static volatile uint8_t in[RING];
static uint8_t out[RING];

void tick_interrupt(void)
{
    steps++;
}

void line_interrupt(void)
{
    const uint32_t status = USART_SR(USART1);

    /* An overrun also requests the interrupt, until status and data are read. */
    if ((status & (USART_SR_RXNE | USART_SR_ORE)) != 0u) {
        const uint8_t byte = (uint8_t)USART_DR(USART1);

        if ((status & USART_SR_RXNE) != 0u && received - taken < RING) { /* otherwise the byte is lost, and its frame damaged */
            in[received % RING] = byte;
            received++;
        }
    }
}

void hal_start(void)
{
    RCC_AHB1ENR |= 1u;
    RCC_APB2ENR |= 1u << 4;
    GPIOA_MODER |= (2u << 18) | (2u << 20);
    GPIOA_AFRH |= (7u << 4) | (7u << 8);
    USART_BRR(USART1) = (CLOCK * 500000u + 460800u) / 921600u;
    USART_CR1(USART1) = USART_CR1_UE | USART_CR1_TE | USART_CR1_RE | USART_CR1_RXNEIE;
    NVIC_ISER(USART1_IRQ / 32u) = 1u << (USART1_IRQ % 32u);
    SYST_RVR = CLOCK * STEP - 1u;
    SYST_CVR = 0;
    SYST_CSR = 7;
    start_motors();
    start_sensors();
}

uint64_t hal_time(void)
{
    static uint64_t last;
    uint64_t before, now;
    uint32_t left;

    do {
        before = steps;
        left = SYST_CVR;
    } while (before != steps);
    now = before * STEP + (CLOCK * STEP - 1u - left) / CLOCK;
    last = now > last ? now : last; /* the timer may have restarted before its interrupt was handled */
    return last;
}

/* No interrupt of an empty transmitter is needed: this function is called every few microseconds. */
static void send_some(void)
{
    while (sent != written && (USART_SR(USART1) & USART_SR_TXE) != 0u) {
        USART_DR(USART1) = out[sent % RING];
        sent++;
    }
}

void hal_idle(void)
{
    send_some();
    if (sent == written && received == taken) {
        __asm volatile("wfi");
    }
}

size_t hal_read_line(uint8_t *bytes, size_t room)
{
    size_t size = 0;

    while (size < room && taken != received) {
        bytes[size++] = in[taken % RING];
        taken++;
    }
    return size;
}

bool hal_write_line(const uint8_t *bytes, size_t size)
{
    size_t k;

    if (size > RING - (written - sent)) {
        return false;
    }
    for (k = 0; k < size; k++) {
        out[written % RING] = bytes[k];
        written++;
    }
    send_some();
    return true;
}

void hal_start_watchdog(uint32_t microseconds)
{
    IWDG_KR = 0x5555;
    IWDG_PR = 0; /* 32 kHz / 4 */
    IWDG_RLR = microseconds / 125u;
    IWDG_KR = 0xCCCC;
}

void hal_feed_watchdog(void)
{
    IWDG_KR = 0xAAAA;
}

int main(void)
{
    board_run();
    return 0;
}
