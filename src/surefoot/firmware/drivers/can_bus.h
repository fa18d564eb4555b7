/* A CAN bus with identifiers of 11 bits. */
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
/* Drop all frames that have not left yet. */
void can_clear(void);
/* Put a frame on its way; false, if there is no room. */
bool can_send(const can_frame *frame);
/* Take the oldest frame that has arrived; false, if there is none. */
bool can_receive(can_frame *frame);

#endif
