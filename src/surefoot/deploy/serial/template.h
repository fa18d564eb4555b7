/* surefoot wire protocol, version ${version}, for robots of ${motors} motors. docs/wire-protocol.md specifies it.
 *
 * Made by `python -m surefoot.deploy.serial.c_header --motors ${motors}`: change the definitions, not this file.
 *
 * A field's comment begins with what its number counts: [0.001 N m] makes 1500 stand for 1.5 N m. Texts are UTF-8, and
 * end at the first zero byte or at their full length. Structs go over the line as they lie in memory, so the
 * processor must be little-endian and its floats IEEE 754. To send, fill a struct and call surefoot_encode. To receive,
 * give every byte to surefoot_decode, and copy the payload into the struct of its type with memcpy. */
#ifndef SUREFOOT_WIRE_H
#define SUREFOOT_WIRE_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "the structs of this header are for little-endian processors"
#endif

#define SUREFOOT_VERSION ${version}u
#define SUREFOOT_SCHEMA 0x${schema}u
#define SUREFOOT_MOTORS ${motors}
#define SUREFOOT_MAX_FRAME ${max_frame}u /* bytes between two zeros beyond which nothing is a frame */
#define SUREFOOT_BODY_BYTES ${body}u /* most bytes of header, payload and CRC-32 together */
#define SUREFOOT_FRAME_BYTES ${frame}u /* most bytes of a frame on the line, with its zeros */

#if defined(__cplusplus) && __cplusplus >= 201103L
#define SUREFOOT_SIZE(type, size) static_assert(sizeof(type) == (size), "size of " #type)
#elif defined(__STDC_VERSION__) && __STDC_VERSION__ >= 201112L
#define SUREFOOT_SIZE(type, size) _Static_assert(sizeof(type) == (size), "size of " #type)
#else
#define SUREFOOT_SIZE(type, size) typedef char size_of_##type[sizeof(type) == (size) ? 1 : -1]
#endif

#ifdef __cplusplus
extern "C" {
#endif

${enums}
#pragma pack(push, 1)

/* Stands in front of every payload. */
typedef struct {
    uint8_t version;   /* SUREFOOT_VERSION; first in every version */
    uint8_t type;      /* a surefoot_type */
    uint32_t schema;   /* SUREFOOT_SCHEMA; at this place in every version */
    uint32_t sequence; /* counts all frames of this sender, from 1 */
    uint64_t time;     /* [1e-6 s] when it was sent, on the sender's clock */
} surefoot_header;

${structs}
#pragma pack(pop)

${sizes}
/* Bytes of a payload; 0 for a type that is none. */
static inline size_t surefoot_payload_size(uint8_t type)
{
    switch (type) {
${cases}    default:
        return 0;
    }
}

/* CRC-32 as in zip and Ethernet: polynomial 04C11DB7, bits reflected, begun with all ones and inverted at the end.
 * The CRC-32 of "123456789" is CBF43926. */
static inline uint32_t surefoot_crc32(const uint8_t *data, size_t length)
{
    /* Remainders of the sixteen values of half a byte. */
    static const uint32_t remainders[16] = {
        0x00000000u, 0x1DB71064u, 0x3B6E20C8u, 0x26D930ACu, 0x76DC4190u, 0x6B6B51F4u, 0x4DB26158u, 0x5005713Cu,
        0xEDB88320u, 0xF00F9344u, 0xD6D6A3E8u, 0xCB61B38Cu, 0x9B64C2B0u, 0x86D3D2D4u, 0xA00AE278u, 0xBDBDF21Cu,
    };
    uint32_t crc = 0xFFFFFFFFu;
    size_t i;

    for (i = 0; i < length; i++) {
        crc ^= data[i];
        crc = (crc >> 4) ^ remainders[crc & 15u];
        crc = (crc >> 4) ^ remainders[crc & 15u];
    }
    return crc ^ 0xFFFFFFFFu;
}

/* Writes `length` bytes without zeros among them; returns how many were written: at most length + length / 254 + 1. */
static inline size_t surefoot_cobs_encode(const uint8_t *data, size_t length, uint8_t *out)
{
    size_t code_at = 0, at = 1, i;
    uint8_t code = 1;

    for (i = 0; i < length; i++) {
        if (data[i] != 0) {
            out[at++] = data[i];
            code++;
        }
        if (data[i] == 0 || (code == 0xFF && i + 1 < length)) {
            out[code_at] = code;
            code_at = at++;
            code = 1;
        }
    }
    out[code_at] = code;
    return at;
}

/* Undoes it; `out` may be `data`. Returns how many bytes were written; 0 for what is no COBS. */
static inline size_t surefoot_cobs_decode(const uint8_t *data, size_t length, uint8_t *out)
{
    size_t from = 0, at = 0;

    while (from < length) {
        const uint8_t code = data[from];
        const size_t end = from + code;

        if (code == 0 || end > length) {
            return 0;
        }
        for (from++; from < end; from++) {
            if (data[from] == 0) {
                return 0;
            }
            out[at++] = data[from];
        }
        if (code != 0xFF && from < length) {
            out[at++] = 0;
        }
    }
    return at;
}

/* Writes a frame with its zeros; returns its bytes, or 0 for a type that is none.
 *   payload   the struct of the message
 *   sequence  counts all frames that this side sends, from 1
 *   time      microseconds on this side's clock
 *   frame     has room for SUREFOOT_FRAME_BYTES */
static inline size_t surefoot_encode(uint8_t type, const void *payload, uint32_t sequence, uint64_t time,
                                     uint8_t *frame)
{
    const size_t size = surefoot_payload_size(type), length = sizeof(surefoot_header) + size;
    uint8_t body[SUREFOOT_BODY_BYTES];
    surefoot_header header;
    uint32_t crc;
    size_t stuffed;

    if (size == 0) {
        return 0;
    }
    header.version = SUREFOOT_VERSION;
    header.type = type;
    header.schema = SUREFOOT_SCHEMA;
    header.sequence = sequence;
    header.time = time;
    memcpy(body, &header, sizeof(header));
    memcpy(body + sizeof(header), payload, size);
    crc = surefoot_crc32(body, length);
    memcpy(body + length, &crc, sizeof(crc));
    frame[0] = 0;
    stuffed = surefoot_cobs_encode(body, length + sizeof(crc), frame + 1);
    frame[stuffed + 1] = 0;
    return stuffed + 2;
}

/* What a byte has ended. */
typedef enum {
    SUREFOOT_NOTHING, /* nothing yet */
    SUREFOOT_FRAME,   /* a whole, known frame: see `header` and surefoot_payload */
    SUREFOOT_DAMAGED, /* bytes that are no whole frame */
    SUREFOOT_FOREIGN, /* a whole frame of another version or schema, which are in `header` */
    SUREFOOT_UNKNOWN  /* a whole frame of a type, or of a length, that this schema does not have */
} surefoot_event;

/* A receiver. Set all of it to zero before the first byte. */
typedef struct {
    surefoot_header header; /* of the last whole frame */
    uint32_t frames;        /* events of each kind */
    uint32_t damaged;
    uint32_t foreign;
    uint32_t unknown;
    size_t length; /* bytes since the last zero; one more than SUREFOOT_MAX_FRAME stands for all beyond it */
    uint8_t held[SUREFOOT_MAX_FRAME];
} surefoot_decoder;

/* The payload of the frame that was just found, until the next byte; copy it into the struct of its type. */
static inline const uint8_t *surefoot_payload(const surefoot_decoder *decoder)
{
    return decoder->held + sizeof(surefoot_header);
}

/* Takes one byte from the line; returns what it has ended. */
static inline surefoot_event surefoot_decode(surefoot_decoder *decoder, uint8_t byte)
{
    size_t length = decoder->length, size;
    uint32_t crc;

    if (byte != 0) {
        if (length < SUREFOOT_MAX_FRAME) {
            decoder->held[length] = byte;
        }
        decoder->length = length <= SUREFOOT_MAX_FRAME ? length + 1 : length;
        return SUREFOOT_NOTHING;
    }
    decoder->length = 0;
    if (length == 0) {
        return SUREFOOT_NOTHING;
    }
    length = length <= SUREFOOT_MAX_FRAME ? surefoot_cobs_decode(decoder->held, length, decoder->held) : 0;
    if (length < sizeof(surefoot_header) + sizeof(crc)) {
        decoder->damaged++;
        return SUREFOOT_DAMAGED;
    }
    length -= sizeof(crc);
    memcpy(&crc, decoder->held + length, sizeof(crc));
    if (crc != surefoot_crc32(decoder->held, length)) {
        decoder->damaged++;
        return SUREFOOT_DAMAGED;
    }
    memcpy(&decoder->header, decoder->held, sizeof(surefoot_header));
    if (decoder->header.version != SUREFOOT_VERSION || decoder->header.schema != SUREFOOT_SCHEMA) {
        decoder->foreign++;
        return SUREFOOT_FOREIGN;
    }
    size = surefoot_payload_size(decoder->header.type);
    if (size == 0 || length != sizeof(surefoot_header) + size) {
        decoder->unknown++;
        return SUREFOOT_UNKNOWN;
    }
    decoder->frames++;
    return SUREFOOT_FRAME;
}

#ifdef __cplusplus
}
#endif

#endif /* SUREFOOT_WIRE_H */
