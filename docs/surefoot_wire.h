/* surefoot wire protocol, version 1, for robots of 8 motors. docs/wire-protocol.md specifies it.
 *
 * Made by `python -m surefoot.deploy.serial.c_header --motors 8`: change the definitions, not this file.
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

#define SUREFOOT_VERSION 1u
#define SUREFOOT_SCHEMA 0x160C5D1Cu
#define SUREFOOT_MOTORS 8
#define SUREFOOT_MAX_FRAME 1024u /* bytes between two zeros beyond which nothing is a frame */
#define SUREFOOT_BODY_BYTES 448u /* most bytes of header, payload and CRC-32 together */
#define SUREFOOT_FRAME_BYTES 452u /* most bytes of a frame on the line, with its zeros */

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

/* What a payload is. */
enum surefoot_type {
    SUREFOOT_HELLO = 1,
    SUREFOOT_PING = 2,
    SUREFOOT_ARM = 3,
    SUREFOOT_POSITION = 4,
    SUREFOOT_PWM = 5,
    SUREFOOT_DAMP = 6,
    SUREFOOT_DISARM = 7,
    SUREFOOT_BYE = 8,
    SUREFOOT_HANDSHAKE = 65,
    SUREFOOT_PONG = 66,
    SUREFOOT_STATE = 67,
    SUREFOOT_FAULT = 68
};

/* What the robot does with its motors. */
enum surefoot_mode {
    SUREFOOT_MODE_DISARMED = 0, /* Motors are damped; commands are refused. */
    SUREFOOT_MODE_POSITION = 1, /* Servos follow position commands. */
    SUREFOOT_MODE_PWM = 2,      /* Motors get the duty that is sent, for identification. */
    SUREFOOT_MODE_FAULT = 3     /* Motors are damped because of a fault, and stay so until armed again. */
};

/* Why a robot refuses something, or has damped its motors. */
enum surefoot_reason {
    SUREFOOT_REASON_NONE = 0,            /* Nothing is wrong. */
    SUREFOOT_REASON_HOST = 1,            /* The operator asked for it. */
    SUREFOOT_REASON_TIMEOUT = 2,         /* No command came for too long. */
    SUREFOOT_REASON_STALE = 3,           /* Too many commands in a row were old, repeated or out of order. */
    SUREFOOT_REASON_COMMAND = 4,         /* A command was not finite or outside the limits. */
    SUREFOOT_REASON_TILT = 5,            /* Roll or pitch passed the robot's limit. */
    SUREFOOT_REASON_BATTERY = 6,         /* The battery is empty. */
    SUREFOOT_REASON_TEMPERATURE = 7,     /* A motor is too hot. */
    SUREFOOT_REASON_BUSY = 8,            /* Another operator has the robot. */
    SUREFOOT_REASON_SESSION = 9,         /* The message names a session that the robot does not know. */
    SUREFOOT_REASON_NOT_CLEAN = 10,      /* The link has not been clean for long enough to arm. */
    SUREFOOT_REASON_SCHEMA = 11,         /* The message is of another version or schema of this protocol. */
    SUREFOOT_REASON_MODE = 12,           /* The message does not go with the robot's mode. */
    SUREFOOT_REASON_STATES_LATE = 13,    /* The robot's states do not come, or not in time. */
    SUREFOOT_REASON_STATES_FROZEN = 14,  /* The robot's states come and do not change. */
    SUREFOOT_REASON_STATES_DAMAGED = 15, /* The robot's states are damaged, or of another layout. */
    SUREFOOT_REASON_NOT_FINITE = 16,     /* A reading is not a finite number, or none that is possible. */
    SUREFOOT_REASON_RESTARTED = 17,      /* The robot's computer has restarted. */
    SUREFOOT_REASON_MOTOR_OFF = 18,      /* A motor is off, or its messages are lost. */
    SUREFOOT_REASON_OTHER_PROGRAM = 19,  /* Another program commands the motors. */
    SUREFOOT_REASON_OWN_CONTROLLER = 20, /* The robot's own controller is active. */
    SUREFOOT_REASON_REMOTE = 21,         /* Somebody uses the remote control. */
    SUREFOOT_REASON_WATCHDOG = 22        /* The process that monitors the supervisor has ended or hangs. */
};

#pragma pack(push, 1)

/* Stands in front of every payload. */
typedef struct {
    uint8_t version;   /* SUREFOOT_VERSION; first in every version */
    uint8_t type;      /* a surefoot_type */
    uint32_t schema;   /* SUREFOOT_SCHEMA; at this place in every version */
    uint32_t sequence; /* counts all frames of this sender, from 1 */
    uint64_t time;     /* [1e-6 s] when it was sent, on the sender's clock */
} surefoot_header;

/* Start a session, or continue one; the answer is `Handshake`, or `Fault` with BUSY. */
typedef struct {
    uint16_t session;      /* number of the session, drawn by the operator; not 0 */
    uint32_t state_period; /* [1e-6 s] time between two states while no command comes */
} surefoot_hello;

/* Ask for a `Pong`; needs no session. */
typedef struct {
    uint32_t token; /* comes back in the pong */
} surefoot_ping;

/* Let the motors follow commands of one kind; a repeated message changes the times. */
typedef struct {
    uint16_t session;        /* the operator's session */
    uint8_t mode;            /* Mode.POSITION or Mode.PWM */
    uint32_t command_period; /* [1e-6 s] time between two commands */
    uint32_t report_after;   /* [1e-6 s] time from a command's arrival to the state that answers it */
} surefoot_arm;

/* Motor angles that the servos hold until the next command. */
typedef struct {
    uint16_t session;              /* the operator's session */
    float target[SUREFOOT_MOTORS]; /* [rad] motor angles, in motor order */
} surefoot_position;

/* Duty of every motor until the next command, without a servo; for identification. */
typedef struct {
    uint16_t session;            /* the operator's session */
    float duty[SUREFOOT_MOTORS]; /* PWM duty, -1 to 1, in motor order */
} surefoot_pwm;

/* Damp the motors at once and stay so until armed again. */
typedef struct {
    uint16_t session; /* the operator's session */
} surefoot_damp;

/* End of commands in good order: damp the motors. */
typedef struct {
    uint16_t session; /* the operator's session */
} surefoot_disarm;

/* End the session: the robot disarms and is free for another operator. */
typedef struct {
    uint16_t session; /* the operator's session */
} surefoot_bye;

/* Name, motors and limits of the robot. */
typedef struct {
    uint16_t session;                      /* the session that it belongs to */
    char robot[24];                        /* name of the robot */
    char firmware[40];                     /* name and version of the firmware */
    char motor_names[SUREFOOT_MOTORS][24]; /* motors, in motor order */
    int8_t motor_signs[SUREFOOT_MOTORS];   /* joint angle = sign * motor angle */
    uint32_t servo_period;                 /* [1e-6 s] time between two servo steps */
    float servo_kp[SUREFOOT_MOTORS];       /* [1/rad] proportional gains, duty per angle; joint actuators: N m/rad */
    float servo_kd[SUREFOOT_MOTORS];       /* [s/rad] derivative gains, duty per speed; joint actuators: N m s/rad */
    uint32_t command_period_min;           /* [1e-6 s] shortest time between commands */
    uint32_t command_period_max;           /* [1e-6 s] longest time between commands */
    float angle_low[SUREFOOT_MOTORS];      /* [rad] lowest motor angles that a command may request */
    float angle_high[SUREFOOT_MOTORS];     /* [rad] highest motor angles that a command may request */
    float tilt_limit;                      /* [rad] roll or pitch beyond which the robot damps itself */
    float voltage_min;                     /* [V] battery voltage below which the robot damps itself */
    float temperature_max;                 /* [degC] motor temperature beyond which the robot damps itself */
    uint32_t command_timeout;              /* [1e-6 s] silence after which an armed robot damps itself */
    uint32_t rearm_after;                  /* [1e-6 s] time that the link must be clean before a damped robot arms */
} surefoot_handshake;

/* Answer to a ping; its header has the robot's time of sending. */
typedef struct {
    uint32_t token; /* the ping's */
} surefoot_pong;

/* Readings of the robot's sensors; sent `report_after` each command, and periodically while none come. */
typedef struct {
    uint16_t session;                      /* operator that the robot obeys; 0: none */
    uint8_t mode;                          /* see Mode */
    uint8_t reason;                        /* why the motors are damped, or an armed robot should sit; see Reason */
    uint32_t command;                      /* sequence number of the last command that was accepted; 0: none */
    uint16_t command_age;                  /* [1e-5 s] time since then, at most 0.655 s */
    uint16_t dropped;                      /* commands refused since the session began, modulo 65536 */
    float motor_angle[SUREFOOT_MOTORS];    /* [rad] motor angles, in motor order */
    float motor_velocity[SUREFOOT_MOTORS]; /* [rad/s] motor speeds */
    int16_t motor_torque[SUREFOOT_MOTORS]; /* [0.005 N m] motor torques, from the currents */
    float roll_pitch_yaw[3];               /* [rad] base in world: yaw about z, then pitch about y, then roll about x */
    float angular_velocity_base[3];        /* [rad/s] in the base frame: x forward, y left, z up */
    float energy;                          /* [J] integral of |sum of torque times speed| since the session began */
    uint16_t voltage;                      /* [0.001 V] battery */
    uint8_t temperature[SUREFOOT_MOTORS];  /* [degC] motors */
} surefoot_state;

/* A refusal or a fault. */
typedef struct {
    uint16_t session; /* operator that it is meant for; 0: whoever listens */
    uint8_t reason;   /* see Reason */
    char text[80];    /* in plain words */
} surefoot_fault;

#pragma pack(pop)

SUREFOOT_SIZE(float, 4);
SUREFOOT_SIZE(surefoot_header, 18);
SUREFOOT_SIZE(surefoot_hello, 6);
SUREFOOT_SIZE(surefoot_ping, 4);
SUREFOOT_SIZE(surefoot_arm, 11);
SUREFOOT_SIZE(surefoot_position, 34);
SUREFOOT_SIZE(surefoot_pwm, 34);
SUREFOOT_SIZE(surefoot_damp, 2);
SUREFOOT_SIZE(surefoot_disarm, 2);
SUREFOOT_SIZE(surefoot_bye, 2);
SUREFOOT_SIZE(surefoot_handshake, 426);
SUREFOOT_SIZE(surefoot_pong, 4);
SUREFOOT_SIZE(surefoot_state, 130);
SUREFOOT_SIZE(surefoot_fault, 83);

/* Bytes of a payload; 0 for a type that is none. */
static inline size_t surefoot_payload_size(uint8_t type)
{
    switch (type) {
    case SUREFOOT_HELLO:
        return sizeof(surefoot_hello);
    case SUREFOOT_PING:
        return sizeof(surefoot_ping);
    case SUREFOOT_ARM:
        return sizeof(surefoot_arm);
    case SUREFOOT_POSITION:
        return sizeof(surefoot_position);
    case SUREFOOT_PWM:
        return sizeof(surefoot_pwm);
    case SUREFOOT_DAMP:
        return sizeof(surefoot_damp);
    case SUREFOOT_DISARM:
        return sizeof(surefoot_disarm);
    case SUREFOOT_BYE:
        return sizeof(surefoot_bye);
    case SUREFOOT_HANDSHAKE:
        return sizeof(surefoot_handshake);
    case SUREFOOT_PONG:
        return sizeof(surefoot_pong);
    case SUREFOOT_STATE:
        return sizeof(surefoot_state);
    case SUREFOOT_FAULT:
        return sizeof(surefoot_fault);
    default:
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
