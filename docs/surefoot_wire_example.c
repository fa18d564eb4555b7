/* How firmware uses surefoot_wire.h: it takes commands and answers pings (docs/wire-protocol.md). */
#include "surefoot_wire.h"

/* What the rest of the firmware has. */
uint64_t microseconds(void);
void write_line(const uint8_t *bytes, size_t size);
void take_position(const surefoot_header *header, const surefoot_position *command);
void spoil_link(void);

static surefoot_decoder decoder; /* all of it zero at first */
static uint32_t sent;

void send_message(uint8_t type, const void *message)
{
    uint8_t frame[SUREFOOT_FRAME_BYTES];
    const size_t size = surefoot_encode(type, message, ++sent, microseconds(), frame);

    write_line(frame, size);
}

void take_byte(uint8_t byte)
{
    const surefoot_event event = surefoot_decode(&decoder, byte);

    if (event == SUREFOOT_FRAME && decoder.header.type == SUREFOOT_POSITION) {
        surefoot_position command;
        memcpy(&command, surefoot_payload(&decoder), sizeof(command));
        take_position(&decoder.header, &command);
    } else if (event == SUREFOOT_FRAME && decoder.header.type == SUREFOOT_PING) {
        surefoot_pong pong;
        memcpy(&pong, surefoot_payload(&decoder), sizeof(pong));
        send_message(SUREFOOT_PONG, &pong);
    } else if (event != SUREFOOT_NOTHING && event != SUREFOOT_FRAME) {
        spoil_link();
    }
}
