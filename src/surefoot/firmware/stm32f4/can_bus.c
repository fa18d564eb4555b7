/* CAN1 of an STM32F405 at 1 Mbit/s, pins B8 (in) and B9 (out). The emulator lacks this peripheral: this file was
 * compiled, but not run. */
#include "can_bus.h"

#include "registers.h"

#define CAN 0x40006400u
#define CAN_MCR REGISTER(CAN + 0x000u)
#define CAN_MSR REGISTER(CAN + 0x004u)
#define CAN_TSR REGISTER(CAN + 0x008u)
#define CAN_RF0R REGISTER(CAN + 0x00Cu)
#define CAN_IER REGISTER(CAN + 0x014u)
#define CAN_BTR REGISTER(CAN + 0x01Cu)
#define CAN_TIR(box) REGISTER(CAN + 0x180u + 0x10u * (box))
#define CAN_TDTR(box) REGISTER(CAN + 0x184u + 0x10u * (box))
#define CAN_TDLR(box) REGISTER(CAN + 0x188u + 0x10u * (box))
#define CAN_TDHR(box) REGISTER(CAN + 0x18Cu + 0x10u * (box))
#define CAN_RIR REGISTER(CAN + 0x1B0u)
#define CAN_RDTR REGISTER(CAN + 0x1B4u)
#define CAN_RDLR REGISTER(CAN + 0x1B8u)
#define CAN_RDHR REGISTER(CAN + 0x1BCu)
#define CAN_FMR REGISTER(CAN + 0x200u)
#define CAN_FS1R REGISTER(CAN + 0x20Cu)
#define CAN_FA1R REGISTER(CAN + 0x21Cu)
#define CAN_F0R1 REGISTER(CAN + 0x240u)
#define CAN_F0R2 REGISTER(CAN + 0x244u)
#define GPIOB_MODER REGISTER(0x40020400u)
#define GPIOB_AFRH REGISTER(0x40020424u)
#define RING 32u /* frames; a power of two */

static can_frame in[RING], out[RING];
static volatile uint32_t received, taken, written, sent;

static void send_some(void)
{
    while (sent != written && (CAN_TSR & (7u << 26)) != 0u) {
        const uint32_t box = CAN_TSR >> 24 & 3u;
        const can_frame *const frame = &out[sent % RING];
        const uint8_t *const d = frame->data;

        CAN_TDTR(box) = frame->length;
        CAN_TDLR(box) = d[0] | (uint32_t)d[1] << 8 | (uint32_t)d[2] << 16 | (uint32_t)d[3] << 24;
        CAN_TDHR(box) = d[4] | (uint32_t)d[5] << 8 | (uint32_t)d[6] << 16 | (uint32_t)d[7] << 24;
        CAN_TIR(box) = (uint32_t)frame->id << 21 | 1u;
        sent++;
    }
}

/* A mailbox is empty. */
void can_transmit_interrupt(void)
{
    CAN_TSR = 1u | 1u << 8 | 1u << 16;
    send_some();
}

void can_receive_interrupt(void)
{
    while ((CAN_RF0R & 3u) != 0u) {
        /* Frames are dropped if they are not data frames with an 11-bit identifier, or if there is no room. */
        if (received - taken < RING && (CAN_RIR & 6u) == 0u && (CAN_RDTR & 15u) <= 8u) {
            can_frame *const frame = &in[received % RING];
            const uint32_t low = CAN_RDLR, high = CAN_RDHR;
            uint32_t k;

            frame->id = (uint16_t)(CAN_RIR >> 21);
            frame->length = (uint8_t)(CAN_RDTR & 15u);
            for (k = 0; k < 4u; k++) {
                frame->data[k] = (uint8_t)(low >> 8u * k);
                frame->data[k + 4u] = (uint8_t)(high >> 8u * k);
            }
            received++;
        }
        CAN_RF0R = 1u << 5;
        while ((CAN_RF0R & 1u << 5) != 0u) {
        }
    }
}

void can_start(void)
{
    uint32_t left = 100000;

    RCC_AHB1ENR |= 2u;
    RCC_APB1ENR |= 1u << 25;
    GPIOB_MODER |= (2u << 16) | (2u << 18);
    GPIOB_AFRH |= (9u << 0) | (9u << 4);
    CAN_MCR = 1u; /* initialize */
    while ((CAN_MSR & 1u) == 0u && --left > 0u) {
    }
    CAN_BTR = 2u | (10u << 16) | (1u << 20); /* 42 MHz / 3, 14 time quanta per bit, sampled after 12 */
    CAN_FMR |= 1u; /* its other bits give CAN1 its share of the filters */
    CAN_FS1R = 1u;
    CAN_F0R1 = CAN_F0R2 = 0; /* accept every frame */
    CAN_FA1R = 1u;
    CAN_FMR &= ~1u;
    CAN_IER = 1u | 1u << 1;
    NVIC_ISER(0) = 1u << CAN1_TX_IRQ | 1u << CAN1_RX0_IRQ;
    CAN_MCR = 1u << 6 | 1u << 2; /* recover after errors; frames are sent in the order of their requests */
}

void can_clear(void)
{
    NVIC_ICER(0) = 1u << CAN1_TX_IRQ; /* the interrupt also sends frames */
    sent = written;
    CAN_TSR = 1u << 7 | 1u << 15 | 1u << 23; /* abort the mailboxes, except a frame that is being sent */
    NVIC_ISER(0) = 1u << CAN1_TX_IRQ;
}

bool can_send(const can_frame *frame)
{
    if (written - sent >= RING) {
        return false;
    }
    out[written % RING] = *frame;
    written++;
    NVIC_ICER(0) = 1u << CAN1_TX_IRQ; /* the interrupt also sends frames */
    send_some();
    NVIC_ISER(0) = 1u << CAN1_TX_IRQ;
    return true;
}

bool can_receive(can_frame *frame)
{
    if (taken == received) {
        return false;
    }
    *frame = in[taken % RING];
    taken++;
    return true;
}
