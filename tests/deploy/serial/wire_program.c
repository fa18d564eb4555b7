/* A program around surefoot_wire.h, for tests: what it does is its first argument. examples.h is made by the test. */
#include <stdio.h>

#include "surefoot_wire.h"

static void emit(uint8_t type, const void *payload, uint32_t sequence, uint64_t time)
{
    uint8_t frame[SUREFOOT_FRAME_BYTES];
    const size_t size = surefoot_encode(type, payload, sequence, time, frame);

    fwrite(frame, 1, size, stdout);
}

#include "examples.h"

static void print_hex(const uint8_t *bytes, size_t size)
{
    size_t i;

    for (i = 0; i < size; i++) {
        printf("%02x", (unsigned)bytes[i]);
    }
    printf("\n");
}

/* Takes a stream from the standard input; tells of each frame what `mode` asks for, and the counts at the end. */
static void receive(const char *mode)
{
    static surefoot_decoder decoder;
    int byte;

    while ((byte = getchar()) != EOF) {
        const surefoot_event event = surefoot_decode(&decoder, (uint8_t)byte);
        const surefoot_header *header = &decoder.header;

        if (event == SUREFOOT_FOREIGN && strcmp(mode, "list") == 0) {
            printf("foreign %u %lu\n", (unsigned)header->version, (unsigned long)header->schema);
        }
        if (event != SUREFOOT_FRAME) {
            continue;
        }
        if (strcmp(mode, "again") == 0) {
            emit(header->type, surefoot_payload(&decoder), header->sequence, header->time);
        } else if (strcmp(mode, "fields") == 0) {
            print_fields(header->type, surefoot_payload(&decoder));
        } else {
            printf("%u %lu %llu ", (unsigned)header->type, (unsigned long)header->sequence,
                   (unsigned long long)header->time);
            print_hex(surefoot_payload(&decoder), surefoot_payload_size(header->type));
        }
    }
    fprintf(stderr, "%lu %lu %lu %lu\n", (unsigned long)decoder.frames, (unsigned long)decoder.damaged,
            (unsigned long)decoder.foreign, (unsigned long)decoder.unknown);
}

/* Takes records of a u16, how many bytes, and the bytes; prints each with COBS done or undone, and its CRC-32. */
static void stuff(int undo)
{
    static uint8_t in[65536], out[65536 + 300];
    uint8_t length[2];

    while (fread(length, 1, 2, stdin) == 2) {
        const size_t size = (size_t)length[0] | (size_t)length[1] << 8;

        if (fread(in, 1, size, stdin) != size) {
            return;
        }
        printf("%08lx ", (unsigned long)surefoot_crc32(in, size));
        print_hex(out, undo ? surefoot_cobs_decode(in, size, out) : surefoot_cobs_encode(in, size, out));
    }
}

int main(int argc, char **argv)
{
    const char *mode = argc > 1 ? argv[1] : "";

    if (strcmp(mode, "examples") == 0) {
        emit_examples();
    } else if (strcmp(mode, "stuff") == 0) {
        stuff(0);
    } else if (strcmp(mode, "unstuff") == 0) {
        stuff(1);
    } else if (strcmp(mode, "sizes") == 0) {
        printf("%lu %d\n", (unsigned long)sizeof(surefoot_decoder), SUREFOOT_MOTORS);
    } else {
        receive(mode);
    }
    return 0;
}
