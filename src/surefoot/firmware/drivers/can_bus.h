/* CAN bus with 11-bit identifiers. */
#ifndef CAN_BUS_H
#define CAN_BUS_H

#include <stdbool.h>
#include <stdint.h>

typedef struct {
    uint16_t id;
    uint8_t length; /* bytes of data, at most 8 */
    uint8_t data[8];
} can_frame;

void can_start(void);
/* Discard all frames that have not been sent yet. */
void can_clear(void);
/* Queue a frame for sending; return false if there is no room. */
bool can_send(const can_frame *frame);
/* Read the oldest frame that has arrived; return false if there is none. */
bool can_receive(can_frame *frame);

#endif
