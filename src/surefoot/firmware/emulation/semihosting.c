#include "semihosting.h"

#include <stdint.h>

#define SYS_OPEN 1u
#define SYS_WRITE 5u
#define SYS_READ 6u
#define SYS_EXIT 0x18u
#define APPLICATION_EXIT 0x20026u

static uintptr_t input, output;

static uintptr_t call(uintptr_t what, const void *arguments)
{
    register uintptr_t r0 __asm("r0") = what;
    register const void *r1 __asm("r1") = arguments;

    __asm volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

static uintptr_t open_file(const char *name, uintptr_t length, uintptr_t mode)
{
    const uintptr_t arguments[] = {(uintptr_t)name, mode, length};

    return call(SYS_OPEN, arguments);
}

void open_host(void)
{
    input = open_file("/dev/stdin", 10, 1);
    output = open_file("/dev/stdout", 11, 5);
}

bool read_host(void *bytes, size_t size)
{
    uint8_t *at = bytes;

    while (size > 0u) {
        const uintptr_t arguments[] = {input, (uintptr_t)at, size};
        const uintptr_t left = call(SYS_READ, arguments);

        if (left >= size) {
            return false;
        }
        at += size - left;
        size = left;
    }
    return true;
}

void write_host(const void *bytes, size_t size)
{
    const uintptr_t arguments[] = {output, (uintptr_t)bytes, size};

    if (size > 0u && call(SYS_WRITE, arguments) != 0u) {
        end_host();
    }
}

void end_host(void)
{
    (void)call(SYS_EXIT, (const void *)APPLICATION_EXIT);
}
